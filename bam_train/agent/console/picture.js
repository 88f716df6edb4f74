// The robot on a canvas, in perspective: an arm with its gripper, the object, the table and the box in which the tool
// works; or a base with what its scanners see. Solids are drawn from the farthest to the nearest, under one light.

const LIGHT = [-0.36, -0.48, 0.8]; // towards it; a unit vector
const GREY = [215, 12, 62], BLUE = [212, 48, 46], DARK = [220, 9, 30], RED = [14, 70, 50]; // hue, saturation, lightness
const JOINTS = new Set([1, 4, 6, 7]); // tubes that are housings of joints
// A gripper from its flange (Robotiq 2F-85): parts of middle [m], half edges [m] and side; a side moves with the width.
const GRIPPER = [[[0, 0, 0.045], [0.05, 0.032, 0.045], 0], ...[-1, 1].flatMap((side) => [[[0.008, 0, 0.112], [0.006, 0.011, 0.022], side], [[0.004, 0, 0.148], [0.004, 0.011, 0.014], side]])];
const OPEN = 0.085; // width of a gripper that is not measured [m]
const EDGE = 0.04; // of the object [m], as in the tasks that have one
const TRAIL = 100; // points of the tool's way

const sum = (a, b, share = 1) => a.map((value, at) => value + share * b[at]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const shade = ([hue, saturation, lightness], more) => `hsl(${hue} ${saturation}% ${Math.round(lightness + more)}%)`;
const UPRIGHT = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

// The axes of a frame that is turned by a unit quaternion.
function axes(x, y, z, w) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

export class Picture {
  constructor(canvas) {
    Object.assign(this, { canvas, azimuth: -1.95, elevation: 0.42, trail: [] });
    canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
    canvas.onpointermove = (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      this.azimuth -= event.movementX / 150;
      this.elevation = Math.min(1.5, Math.max(0.05, this.elevation + event.movementY / 150));
      if (this.shown) this.draw(this.shown);
    };
  }

  draw(telemetry) {
    const { canvas } = this, scale = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (telemetry.tool && telemetry !== this.shown) this.trail = [...this.trail.slice(1 - TRAIL), telemetry.tool];
    this.shown = telemetry;
    if (width === 0) return;
    const style = getComputedStyle(canvas), context = canvas.getContext("2d");
    Object.assign(this, { context, width, height, solids: [], colour: (name) => style.getPropertyValue(`--${name}`) });
    Object.assign(canvas, { width: width * scale, height: height * scale }); // which clears it
    context.scale(scale, scale);
    context.lineCap = context.lineJoin = "round";
    context.font = "13px system-ui, sans-serif";
    if (telemetry.tubes) this.arm(telemetry);
    else if (telemetry.base) this.base(telemetry);
    else this.text([12, 24], "This robot's shape is not known; see its numbers.");
  }

  // Look at a point [m] from a distance [m].
  look(centre, distance) {
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
    const focus = 1.7 * Math.min(this.width, 1.2 * this.height), towards = [ca * ce, sa * ce, se];
    this.eye = sum(centre, towards, distance);
    this.turn = ([x, y, z]) => [ca * y - sa * x, (ca * x + sa * y) * se - z * ce]; // to the right, and down
    this.project = (point) => { // to x, y on the canvas, depth [m], and pixels per metre there
      const from = sum(point, centre, -1), [right, down] = this.turn(from), depth = Math.max(0.1, distance - dot(from, towards)), scale = focus / depth;
      return [this.width / 2 + right * scale, this.height / 2 + down * scale, depth, scale];
    };
  }

  path(points, style, width, isFilled = false) {
    const { context } = this;
    context.beginPath();
    for (const point of points) context.lineTo(...this.project(point).slice(0, 2));
    context.lineWidth = width;
    context.strokeStyle = context.fillStyle = style;
    if (isFilled) { context.closePath(); context.fill(); }
    if (width) context.stroke();
  }

  text([x, y], words) {
    this.context.fillStyle = this.colour("ink");
    this.context.fillText(words, Math.min(x, this.width - 4 - this.context.measureText(words).width), y);
  }

  // A square of ground with lines every `step` [m].
  ground([x, y, z], half, step) {
    this.path([[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([u, v]) => [x + u * half, y + v * half, z]), this.colour("wood"), 0, true);
    const grid = this.colour("grid");
    for (let at = -half; at <= half + 1e-9; at += step) {
      this.path([[x + at, y - half, z], [x + at, y + half, z]], grid, 1);
      this.path([[x - half, y + at, z], [x + half, y + at, z]], grid, 1);
    }
  }

  tube(a, b, radius, colour) {
    const [xa, ya, da, sa] = this.project(a), [xb, yb, db, sb] = this.project(b), thick = radius * (sa + sb), length = Math.hypot(xb - xa, yb - ya);
    const [u, v] = length < 1 ? [0, thick / 2] : [((ya - yb) / length) * thick * 0.5, ((xb - xa) / length) * thick * 0.5], sign = u + 2 * v > 0 ? -1 : 1;
    this.solids.push([(da + db) / 2, () => {
      const round = this.context.createLinearGradient(xa + sign * u, ya + sign * v, xa - sign * u, ya - sign * v);
      for (const [at, more] of [[0, 4], [0.3, 20], [0.75, -6], [1, -20]]) round.addColorStop(at, shade(colour, more));
      this.path([a, b], shade(colour, -30), thick + 1.5);
      this.path([a, b], round, thick);
    }]);
  }

  box(centre, [x, y, z], half, colour) {
    const turns = [[x, y, z, 0, 1, 2], [y, z, x, 1, 2, 0], [z, x, y, 2, 0, 1]].flatMap((one) => [[...one, 1], [...one, -1]]);
    this.solids.push([this.project(centre)[2], () => {
      for (const [normal, along, across, n, u, v, sign] of turns) {
        const middle = sum(centre, normal, sign * half[n]);
        if (sign * dot(normal, sum(this.eye, middle, -1)) <= 0) continue;
        const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([s, t]) => sum(sum(middle, along, s * half[u]), across, t * half[v]));
        this.path(corners, shade(colour, 14 * sign * dot(normal, LIGHT)), 1, true);
      }
    }]);
  }

  arm({ tubes, hand, object, box, table, state }) {
    const size = tubes.reduce((all, [x, y, z, u, v, w]) => all + Math.hypot(u - x, v - y, w - z), 0); // all its links [m]
    const floor = table ?? 0, half = 0.1 * Math.ceil(3.6 * size), onFloor = ([x, y]) => [x, y, floor];
    this.look([0.2 * size, 0, 0.16 * size], 1.75 * size);
    this.ground([0.22 * size, 0, floor], half, 0.1);
    if (box?.every((value) => value !== null && Math.abs(value) < size)) {
      const [x, y, z, u, v, w] = box;
      this.context.setLineDash([5, 5]);
      for (const height of [z, w]) this.path([[x, y, height], [u, y, height], [u, v, height], [x, v, height], [x, y, height]], this.colour("box"), 1);
      for (const [p, q] of [[x, y], [u, y], [u, v], [x, v]]) this.path([[p, q, z], [p, q, w]], this.colour("box"), 1);
      this.context.setLineDash([]);
      this.text(this.project([u, y, w + 0.02]), "workspace");
    }
    tubes.forEach(([x, y, z, u, v, w, radius], at) => {
      this.path([onFloor([x, y]), onFloor([u, v])], this.colour("shade"), 2 * radius * this.project(onFloor([x, y]))[3]);
      this.tube([x, y, at ? z : z + radius / 2], [u, v, w], radius, JOINTS.has(at) ? BLUE : GREY);
    });
    if (hand?.every((value) => value !== null)) {
      const turned = axes(...hand.slice(3)), width = state.gripper_width?.gripper_width ?? OPEN;
      for (const [[x, y, z], sizes, side] of GRIPPER) {
        const place = [side * (x + width / 2), y, z].reduce((at, value, n) => sum(at, turned[n], value), hand.slice(0, 3));
        this.box(place, turned, sizes, DARK);
      }
    }
    if (object?.every((value) => value !== null)) {
      const turned = axes(...object.slice(3));
      this.path([onFloor(object), onFloor(object)], this.colour("shade"), 1.2 * EDGE * this.project(object)[3]);
      this.box(object.slice(0, 3), turned, [EDGE / 2, EDGE / 2, EDGE / 2], RED);
    }
    this.paint();
    this.path(this.trail, this.colour("act"), 1.5);
  }

  base({ base: [x, y, yaw], outline: [front, back, side], scan }) {
    const [c, s] = [Math.cos(yaw), Math.sin(yaw)], placed = ([u, v], z = 0) => [x + c * u - s * v, y + s * u + c * v, z];
    this.look([x, y, 0], 7);
    this.ground([Math.round(x), Math.round(y), 0], 4, 1);
    this.context.fillStyle = this.colour("act");
    for (const point of scan) this.context.fillRect(...this.project(placed(point)).slice(0, 2).map((at) => at - 1.5), 3, 3);
    const turned = [[c, s, 0], [-s, c, 0], UPRIGHT[2]];
    this.box(placed([(front - back) / 2, 0], 0.19), turned, [(front + back) / 2, side, 0.16], GREY);
    this.box(placed([front, 0], 0.22), turned, [0.01, 0.7 * side, 0.05], BLUE); // where its front is
    this.paint();
  }

  // The solids, and the directions of the axes in a corner.
  paint() {
    this.solids.sort(([one], [other]) => other - one).forEach(([, draw]) => draw());
    this.context.strokeStyle = this.colour("quiet");
    this.context.lineWidth = 2;
    UPRIGHT.forEach((axis, at) => {
      const [right, down] = this.turn(axis), place = (length) => [32 + length * right, this.height - 40 + length * down];
      this.context.beginPath();
      this.context.moveTo(...place(0));
      this.context.lineTo(...place(26));
      this.context.stroke();
      this.text(sum(place(36), [-4, 4]), "xyz"[at]);
    });
  }
}
