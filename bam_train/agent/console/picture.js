// The robot in three dimensions, on a plain canvas: the tubes of an arm, or the outline of a base and what it scans.

function colours() {
  const style = getComputedStyle(document.documentElement);
  return { ink: style.getPropertyValue("--ink"), line: style.getPropertyValue("--line"), act: style.getPropertyValue("--act") };
}

// The canvas in its size on the screen, cleared; its context, width and height in CSS pixels.
export function cleared(canvas) {
  const scale = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, width, height);
  return [context, width, height];
}

export class Picture {
  constructor(canvas) {
    this.canvas = canvas;
    this.azimuth = -2.3;
    this.elevation = 0.45;
    this.trail = [];
    canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
    canvas.onpointermove = (event) => {
      if (!canvas.hasPointerCapture(event.pointerId)) return;
      this.azimuth -= event.movementX / 150;
      this.elevation = Math.min(1.5, Math.max(0.05, this.elevation + event.movementY / 150));
      if (this.shown) this.draw(this.shown);
    };
  }

  draw(telemetry) {
    this.shown = telemetry;
    const [context, width, height] = cleared(this.canvas);
    if (width === 0) return;
    context.lineCap = context.lineJoin = "round";
    if (telemetry.tubes) this.arm(context, width, height, telemetry);
    else if (telemetry.base) this.base(context, width, height, telemetry);
    else context.fillText("This robot's shape is not known; see its numbers.", 12, 24);
  }

  // A function from a point [m] to x, y on the canvas, depth, and pixels per metre there.
  camera(width, height, centre, distance) {
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
    const focus = 1.7 * Math.min(width, height);
    return ([px, py, pz]) => {
      const [x, y, z] = [px - centre[0], py - centre[1], pz - centre[2]];
      const side = -sa * x + ca * y, near = ca * x + sa * y;
      const depth = distance - (near * ce + z * se), up = z * ce - near * se;
      const scale = focus / Math.max(0.1, depth);
      return [width / 2 + side * scale, height / 2 - up * scale, depth, scale];
    };
  }

  grid(context, project, half, step, line) {
    context.strokeStyle = line;
    context.lineWidth = 0.5;
    context.beginPath();
    for (let at = -half; at <= half + 1e-9; at += step) {
      for (const [from, to] of [[[at, -half, 0], [at, half, 0]], [[-half, at, 0], [half, at, 0]]]) {
        context.moveTo(...project(from).slice(0, 2));
        context.lineTo(...project(to).slice(0, 2));
      }
    }
    context.stroke();
  }

  stroke(context, project, points, style, width) {
    context.strokeStyle = style;
    context.lineWidth = width;
    context.beginPath();
    points.forEach((point, at) => {
      const [x, y] = project(point);
      if (at) context.lineTo(x, y);
      else context.moveTo(x, y);
    });
    context.stroke();
  }

  arm(context, width, height, { tubes, tool }) {
    const { ink, line, act } = colours(), project = this.camera(width, height, [0.2, 0, 0.3], 2.6);
    this.grid(context, project, 0.8, 0.2, line);
    // The shadow on the table shows heights.
    for (const [x, y, , u, v] of tubes) this.stroke(context, project, [[x, y, 0], [u, v, 0]], line, 2);
    const rows = tubes.map((tube) => {
      const [a, b] = [tube.slice(0, 3), tube.slice(3, 6)], [pa, pb] = [project(a), project(b)];
      return { a, b, depth: (pa[2] + pb[2]) / 2, thick: tube[6] * (pa[3] + pb[3]) };
    });
    rows.sort((one, other) => other.depth - one.depth);
    for (const { a, b, depth, thick } of rows) {
      const light = Math.round(45 + 25 * Math.min(1, Math.max(0, (3.2 - depth) / 1.6)));
      this.stroke(context, project, [a, b], ink, thick + 2);
      this.stroke(context, project, [a, b], `hsl(212 30% ${light}%)`, thick);
    }
    if (!tool) return;
    this.trail = [...this.trail.slice(-99), tool];
    this.stroke(context, project, this.trail, act, 2);
    const [x, y] = project(tool);
    context.strokeStyle = act;
    context.lineWidth = 2;
    context.strokeRect(x - 5, y - 5, 10, 10);
    context.fillStyle = ink;
    context.font = "14px system-ui, sans-serif";
    context.fillText("tool", x + 9, y + 4);
  }

  base(context, width, height, { base, outline, scan }) {
    const { ink, line, act } = colours(), project = this.camera(width, height, [0, 0, 0], 7);
    const [c, s] = [Math.cos(base[2]), Math.sin(base[2])], [front, back, side] = outline;
    const placed = ([x, y]) => [c * x - s * y, s * x + c * y, 0];
    this.grid(context, project, 4, 1, line);
    context.fillStyle = act;
    for (const point of scan) {
      const [x, y] = project(placed(point));
      context.fillRect(x - 1.5, y - 1.5, 3, 3);
    }
    for (const high of [0, 0.35]) {
      const box = [[front, side], [front, -side], [-back, -side], [-back, side], [front, side]];
      this.stroke(context, project, box.map((one) => [...placed(one).slice(0, 2), high]), ink, 2);
    }
    this.stroke(context, project, [placed([0, 0]), placed([front + 0.3, 0])], act, 4); // where its front is
  }
}
