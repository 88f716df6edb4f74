// The robot in 3-D, by three.js, in a worker: an arm from its description, whose joints turn as they are measured, with
// its gripper, the object, the table and the box in which the tool works; or a base with what its scanners see. Metres, z up.

import * as three from "./three.module.min.js";

const LINKS = [0xe3e6ea, 0x4b7fb8], GRIPPER = 0x2b2f36, PAD = 0x5a606a, OBJECT = 0xd9532f, GOAL = 0x1ab34d;
const FIELD = 30; // height of the view [degrees]
const Y = new three.Vector3(0, 1, 0); // axis of a capsule of three.js

three.Object3D.DEFAULT_UP.set(0, 0, 1);
const known = (values) => values?.every((value) => value !== null) ?? false;
const pose = (rows) => new three.Matrix4().set(...rows);
const vector = (values) => new three.Vector3(...values);

// Whether it is no processor that draws, by a renderer of its own: then shadows and smooth edges would take too long.
function hasGpu() {
  const probe = new OffscreenCanvas(1, 1).getContext("webgl2"), names = probe?.getExtension("WEBGL_debug_renderer_info");
  return !/swiftshader|llvmpipe|software|basic render/i.test(probe?.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? probe.RENDERER));
}

export class Scene {
  constructor(canvas) {
    const quick = hasGpu(), context = canvas.getContext("webgl2", { antialias: quick });
    if (!context) throw new Error("This browser has no WebGL 2, which draws the robot. Everything else works.");
    const renderer = new three.WebGLRenderer({ canvas, context });
    renderer.shadowMap.enabled = quick;
    Object.assign(this, { renderer, quick, camera: new three.PerspectiveCamera(FIELD, 1, 0.01, 100), focus: vector([0, 0, 0]), distance: 1 });
  }

  // Draw another robot, from what the agent told of it, in the colours of the page.
  show(told, colours) {
    this.scene?.traverse((one) => { one.geometry?.dispose(); one.material?.dispose?.(); });
    Object.assign(this, { colours, robot: told, joints: [], fingers: [], goals: [], size: 0, body: null, scene: new three.Scene() });
    this.sun = new three.DirectionalLight(0xffffff, 2);
    this.scene.add(new three.HemisphereLight(0xffffff, 0x9a948c, 1.6), this.sun, this.sun.target);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    if (told.placements) this.arm(told);
  }

  // See it from an eye, and look at a target: from the middle of the robot, by the distance from which it is seen whole.
  look({ eye, target, width, height, ratio }) {
    this.renderer.setPixelRatio(this.quick ? Math.min(ratio, 2) : 1);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    Object.assign(this, { eye: vector(eye), target: vector(target) });
  }

  solid(parent, geometry, colour, place = [0, 0, 0]) {
    const mesh = new three.Mesh(geometry, new three.MeshStandardMaterial({ color: colour, roughness: 0.55 }));
    mesh.position.set(...place);
    Object.assign(mesh, { castShadow: true, receiveShadow: true });
    parent.add(mesh);
    return mesh;
  }

  box(parent, half, colour, place) {
    return this.solid(parent, new three.BoxGeometry(...half.map((edge) => 2 * edge)), colour, place);
  }

  line(colour, kind = three.Line) {
    const material = kind === three.Points ? new three.PointsMaterial({ size: 0.08 }) : new three.LineBasicMaterial();
    material.color.set(this.colours[colour]);
    const line = new kind(new three.BufferGeometry(), material);
    line.frustumCulled = false;
    this.scene.add(line);
    return line;
  }

  // A square of ground with lines every `step` [m], and the light above it.
  ground([x, y, z], half, step) {
    this.floor = new three.Group();
    const plane = this.solid(this.floor, new three.PlaneGeometry(2 * half, 2 * half), this.colours.wood, [0, 0, -0.001]);
    plane.castShadow = false;
    const grid = new three.GridHelper(2 * half, Math.round((2 * half) / step), this.colours.grid, this.colours.grid);
    grid.rotation.x = Math.PI / 2;
    this.floor.add(grid);
    this.floor.position.set(x, y, z);
    this.sun.position.set(-half, -1.4 * half, 2.5 * half).add(this.floor.position);
    this.sun.target = this.floor;
    Object.assign(this.sun.shadow.camera, { left: -half, right: half, top: half, bottom: -half, far: 6 * half });
    this.scene.add(this.floor);
  }

  arm({ mount, placements, axes, tool, capsules, gripper, cube, box, table }) {
    const frame = (parent, rows, name) => {
      const group = new three.Group();
      group.name = name;
      group.applyMatrix4(pose(rows));
      parent.add(group);
      return group;
    };
    const links = [frame(this.scene, mount, "link 0")];
    placements.forEach((rows, at) => { // the frame of a joint, and in it the link that turns
      const joint = frame(at ? links[at] : this.scene, rows, `joint ${at + 1}`), link = new three.Group();
      link.name = `link ${at + 1}`;
      joint.add(link);
      links.push(link);
      this.joints.push([link, vector(axes[at])]);
      this.size += at ? Math.hypot(rows[3], rows[7], rows[11]) : 0;
    });
    const end = frame(links.at(-1), tool, "tool"), size = (this.size += Math.hypot(tool[3], tool[7], tool[11]));
    for (const [link, x, y, z, u, v, w, radius] of capsules) {
      const way = vector([u - x, v - y, w - z]), length = way.length();
      const part = this.solid(links[link], new three.CapsuleGeometry(radius, length, 8, 24), LINKS[link % 2], [(x + u) / 2, (y + v) / 2, (z + w) / 2]);
      Object.assign(part.material, { polygonOffset: true, polygonOffsetFactor: link % 2, polygonOffsetUnits: link % 2 }); // ends that coincide
      if (length > 1e-6) part.quaternion.setFromUnitVectors(Y, way.divideScalar(length));
    }
    gripper?.boxes.forEach(([x, y, z, ...half], at) => { // the palm, then a finger and its pad for each side
      if (at === 0) this.box(end, half, GRIPPER, [x, y, z]);
      else for (const side of [-1, 1]) {
        const part = this.box(end, half, at === 1 ? GRIPPER : PAD, [side * x, y, z]);
        part.name = `${["", "finger", "pad"][at]} ${side}`;
        this.fingers.push([part, side, x]);
      }
    });
    this.open(gripper?.width);
    this.object = this.box(this.scene, [cube / 2, cube / 2, cube / 2], OBJECT);
    this.object.name = "object";
    this.object.visible = false;
    if (known(box) && box.every((value) => Math.abs(value) < size)) {
      const [x, y, z, u, v, w] = box, edges = new three.EdgesGeometry(new three.BoxGeometry(u - x, v - y, w - z));
      const room = new three.LineSegments(edges, new three.LineDashedMaterial({ color: this.colours.box, dashSize: 0.02, gapSize: 0.015 }));
      room.position.set((x + u) / 2, (y + v) / 2, (z + w) / 2);
      room.name = "workspace";
      this.scene.add(room.computeLineDistances());
    }
    this.trail = this.line("act");
    this.scene.add(new three.AxesHelper(0.3 * size));
    this.ground([0.22 * size, 0, Number.isFinite(table) ? table : 0], 0.1 * Math.ceil(9 * size), 0.1);
    Object.assign(this, { focus: vector([0.22 * size, 0, 0.22 * size]), distance: 2.1 * size });
  }

  // Put the fingers at a width [m].
  open(width = 0) {
    for (const [part, side, x] of this.fingers) part.position.x = side * (x + width / 2);
  }

  base({ base: [x, y, yaw], outline, scan }) {
    if (!this.body) {
      this.body = new three.Group();
      this.body.name = "base";
      const front = Math.max(...outline.map(([u]) => u)), shape = new three.Shape(outline.map(([u, v]) => new three.Vector2(u, v)));
      const side = Math.max(0.02, ...outline.map(([u, v]) => (u > 0.6 * front ? Math.abs(v) : 0)));
      this.solid(this.body, new three.ExtrudeGeometry(shape, { depth: 0.32, bevelEnabled: false }), LINKS[0], [0, 0, 0.03]);
      this.box(this.body, [0.12 * front, 0.5 * side, 0.01], LINKS[1], [0.7 * front, 0, 0.35]); // where its front is
      this.scan = this.line("act", three.Points);
      this.scene.add(this.body);
      this.ground([Math.round(x), Math.round(y), 0], 5, 1);
      this.distance = 8;
    }
    this.focus.set(x, y, 0);
    this.floor.position.set(Math.round(x), Math.round(y), 0);
    this.body.position.set(x, y, 0);
    this.body.rotation.z = yaw;
    this.points(this.scan, scan.map(([u, v]) => vector([x + u * Math.cos(yaw) - v * Math.sin(yaw), y + u * Math.sin(yaw) + v * Math.cos(yaw), 0.2])));
  }

  points(line, points) {
    line.geometry.dispose();
    line.geometry = new three.BufferGeometry().setFromPoints(points);
  }

  // Draw a message of telemetry, and the way that the tool has gone.
  draw({ state, object, goals = [], ...more }, way) {
    if (more.base) this.base(more);
    while (this.goals.length < goals.length) {
      this.goals.push(this.solid(this.scene, new three.SphereGeometry(more.base ? 0.1 : 0.015), GOAL));
      this.goals.at(-1).name = `goal ${this.goals.length}`;
    }
    this.goals.forEach((one, at) => { one.visible = known(goals[at]); if (one.visible) one.position.set(...goals[at]); });
    const turns = (this.robot.joints ?? []).map(([signal, label]) => state[signal]?.[label] ?? null);
    if (this.joints.length && known(turns)) {
      this.joints.forEach(([link, axis], at) => link.quaternion.setFromAxisAngle(axis, turns[at]));
      this.open(state.gripper_width?.gripper_width ?? this.robot.gripper?.width);
      this.points(this.trail, way.map(vector));
      this.object.visible = known(object);
      if (this.object.visible) {
        this.object.position.set(...object.slice(0, 3));
        this.object.quaternion.set(...object.slice(3));
      }
    }
  }

  render() {
    this.camera.position.copy(this.focus).addScaledVector(this.eye, this.distance);
    this.camera.lookAt(this.focus.clone().addScaledVector(this.target, this.distance));
    this.renderer.render(this.scene, this.camera);
  }
}

// As a worker: takes a canvas, then what changed, and answers once it is drawn.
let scene = null;

function take({ data: { canvas, told, colours, view, telemetry, way } }) {
  try {
    if (canvas) scene = new Scene(canvas);
    if (told) scene.show(told, colours);
    if (view) scene.look(view);
    if (telemetry) scene.draw(telemetry, way);
    scene.render();
    setTimeout(() => postMessage({})); // once it is on the screen
  } catch (error) {
    postMessage({ error: error.message });
  }
}

if (!globalThis.document) globalThis.onmessage = take;
