// The robot in 3-D, by three.js: an arm from its description, whose joints turn as they are measured, with its gripper,
// the object, the table and the box in which the tool works; or a base with what its scanners see. Metres, z up.

import * as three from "./three.module.min.js";
import { OrbitControls } from "./OrbitControls.js";

const LINKS = [0xe3e6ea, 0x4b7fb8], GRIPPER = 0x2b2f36, PAD = 0x5a606a, OBJECT = 0xd9532f;
const TRAIL = 100; // points of the tool's way
const TURN = [-1.95, 0.42], FIELD = 30; // first direction of the view: azimuth, elevation [rad]; its height [degrees]
const Y = new three.Vector3(0, 1, 0); // axis of a capsule of three.js

three.Object3D.DEFAULT_UP.set(0, 0, 1);
const known = (values) => values?.every((value) => value !== null) ?? false;
const pose = (rows) => new three.Matrix4().set(...rows);

export class Picture {
  constructor(canvas) {
    const quick = canvas.getContext("webgl2", { antialias: true, failIfMajorPerformanceCaveat: true });
    const context = quick ?? canvas.getContext("webgl2", { antialias: false }); // the processor draws, in place of a GPU
    if (!context) throw new Error("This browser has no WebGL 2, which draws the robot. Everything else works.");
    const renderer = new three.WebGLRenderer({ canvas, context });
    renderer.setPixelRatio(quick ? Math.min(devicePixelRatio, 2) : 1);
    renderer.shadowMap.enabled = Boolean(quick);
    const camera = new three.PerspectiveCamera(FIELD, 1, 0.01, 100), controls = new OrbitControls(camera, canvas);
    Object.assign(controls, { maxPolarAngle: 1.55, zoomSpeed: 2 });
    controls.addEventListener("change", () => this.render());
    canvas.style.touchAction = "pan-y"; // a finger scrolls the page up and down, and turns the robot left and right
    Object.assign(this, { canvas, renderer, camera, controls, told: null });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.show(JSON.parse(this.told ?? "{}"), true));
    new ResizeObserver(() => this.render()).observe(canvas);
  }

  // Draw another robot, from what the agent told of it.
  show(told, isAgain = false) {
    const text = JSON.stringify(told);
    if (text === this.told && !isAgain) return;
    this.scene?.traverse((one) => { one.geometry?.dispose(); one.material?.dispose?.(); });
    Object.assign(this, { told: text, robot: told, way: [], joints: [], fingers: [], size: 0, body: null, scene: new three.Scene() });
    this.sun = new three.DirectionalLight(0xffffff, 2);
    this.scene.add(new three.HemisphereLight(0xffffff, 0x9a948c, 1.6), this.sun, this.sun.target);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    if (told.placements) this.arm(told);
  }

  colour(name) {
    return new three.Color(getComputedStyle(this.canvas).getPropertyValue(`--${name}`).trim());
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
    material.color = this.colour(colour);
    const line = new kind(new three.BufferGeometry(), material);
    line.frustumCulled = false;
    this.scene.add(line);
    return line;
  }

  // A square of ground with lines every `step` [m], the light above it, and the eye before it.
  ground([x, y, z], half, step, centre, distance) {
    this.floor = new three.Group();
    const plane = this.solid(this.floor, new three.PlaneGeometry(2 * half, 2 * half), this.colour("wood"), [0, 0, -0.001]);
    plane.castShadow = false;
    const grid = new three.GridHelper(2 * half, Math.round((2 * half) / step), this.colour("grid"), this.colour("grid"));
    grid.rotation.x = Math.PI / 2;
    this.floor.add(grid);
    this.floor.position.set(x, y, z);
    this.sun.position.set(-half, -1.4 * half, 2.5 * half).add(this.floor.position);
    this.sun.target = this.floor;
    Object.assign(this.sun.shadow.camera, { left: -half, right: half, top: half, bottom: -half, far: 6 * half });
    this.scene.add(this.floor);
    const [azimuth, elevation] = TURN;
    this.controls.target.set(...centre);
    this.camera.position.set(Math.cos(azimuth) * Math.cos(elevation), Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation));
    this.camera.position.multiplyScalar(distance).add(this.controls.target);
    this.controls.update();
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
      this.joints.push([link, new three.Vector3(...axes[at])]);
      this.size += at ? Math.hypot(rows[3], rows[7], rows[11]) : 0;
    });
    const end = frame(links.at(-1), tool, "tool"), size = (this.size += Math.hypot(tool[3], tool[7], tool[11]));
    for (const [link, x, y, z, u, v, w, radius] of capsules) {
      const way = new three.Vector3(u - x, v - y, w - z), length = way.length();
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
    if (known(box) && box.every((value) => Math.abs(value) < 2 * size)) {
      const [x, y, z, u, v, w] = box, edges = new three.EdgesGeometry(new three.BoxGeometry(u - x, v - y, w - z));
      const room = new three.LineSegments(edges, new three.LineDashedMaterial({ color: this.colour("box"), dashSize: 0.02, gapSize: 0.015 }));
      room.position.set((x + u) / 2, (y + v) / 2, (z + w) / 2);
      room.name = "workspace";
      this.scene.add(room.computeLineDistances());
    }
    this.trail = this.line("act");
    this.scene.add(new three.AxesHelper(0.3 * size));
    this.ground([0.22 * size, 0, Number.isFinite(table) ? table : 0], 0.1 * Math.ceil(9 * size), 0.1, [0.22 * size, 0, 0.22 * size], 2.1 * size);
  }

  // Put the fingers at a width [m].
  open(width = 0) {
    for (const [part, side, x] of this.fingers) part.position.x = side * (x + width / 2);
  }

  base({ base: [x, y, yaw], outline: [front, back, side], scan }) {
    if (!this.body) {
      this.body = new three.Group();
      this.body.name = "base";
      this.box(this.body, [(front + back) / 2, side, 0.16], LINKS[0], [(front - back) / 2, 0, 0.19]);
      this.box(this.body, [0.06, 0.7 * side, 0.01], LINKS[1], [front - 0.1, 0, 0.35]); // where its front is
      this.scan = this.line("act", three.Points);
      this.scene.add(this.body);
      this.ground([Math.round(x), Math.round(y), 0], 5, 1, [x, y, 0], 8);
    }
    const moved = new three.Vector3(x, y, 0).sub(this.body.position.setZ(0));
    this.camera.position.add(moved);
    this.controls.target.add(moved);
    this.floor.position.set(Math.round(x), Math.round(y), 0);
    this.body.position.set(x, y, 0);
    this.body.rotation.z = yaw;
    this.points(this.scan, scan.map(([u, v]) => new three.Vector3(x + u * Math.cos(yaw) - v * Math.sin(yaw), y + u * Math.sin(yaw) + v * Math.cos(yaw), 0.2)));
  }

  points(line, points) {
    line.geometry.dispose();
    line.geometry = new three.BufferGeometry().setFromPoints(points);
  }

  // Whether the robot of this telemetry has a shape that is known.
  draw({ state, tool, object, ...more }) {
    if (more.base) this.base(more);
    const turns = (this.robot.joints ?? []).map(([signal, label]) => state[signal]?.[label] ?? null);
    if (this.joints.length && known(turns)) {
      this.joints.forEach(([link, axis], at) => link.quaternion.setFromAxisAngle(axis, turns[at]));
      this.open(state.gripper_width?.gripper_width ?? this.robot.gripper?.width);
      if (known(tool)) this.way = [...this.way.slice(1 - TRAIL), new three.Vector3(...tool)];
      this.points(this.trail, this.way);
      this.object.visible = known(object);
      if (this.object.visible) {
        this.object.position.set(...object.slice(0, 3));
        this.object.quaternion.set(...object.slice(3));
      }
    }
    this.render();
    return Boolean(this.joints.length || this.body);
  }

  render() {
    const { canvas, camera, renderer } = this, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!this.scene || !width) return;
    const size = renderer.getSize(new three.Vector2());
    if (size.x !== width || size.y !== height) {
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
    }
    renderer.render(this.scene, camera);
  }
}
