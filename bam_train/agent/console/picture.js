// The robot's canvas and the eye before it. A worker draws, so that buttons and keys are heard whatever that takes.

import { OrbitControls } from "./OrbitControls.js";
import { Object3D, PerspectiveCamera } from "./three.core.min.js";
import { MISSING, restAfter } from "./panels.js";

const TURN = [-1.95, 0.42]; // first direction of the eye: azimuth, elevation [rad]
const TRAIL = 100; // points of the tool's way
const COLOURS = ["wood", "grid", "act", "box"];

Object3D.DEFAULT_UP.set(0, 0, 1);

export class Picture {
  // Draws in the place of a canvas; failed(why): it cannot.
  constructor(place, failed) {
    const canvas = place.cloneNode(), camera = new PerspectiveCamera(), [azimuth, elevation] = TURN;
    place.replaceWith(canvas);
    camera.position.set(Math.cos(azimuth) * Math.cos(elevation), Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation));
    const controls = new OrbitControls(camera, canvas);
    Object.assign(controls, { minDistance: 0.1, maxDistance: 5, maxPolarAngle: 1.55 });
    canvas.style.touchAction = "pan-y"; // a finger scrolls the page up and down, and turns the robot left and right
    Object.assign(this, { canvas, camera, controls, told: null, way: [], next: {}, sent: null, rested: -Infinity });
    this.worker = new Worker("scene.js", { type: "module" });
    this.worker.onerror = () => failed(MISSING);
    this.worker.onmessage = ({ data: { error } }) => {
      if (error) { failed(error); return; } // and nothing more is sent
      this.rested = performance.now() + restAfter(performance.now() - this.sent);
      this.sent = null;
      if (this.next.view || this.next.told) this.send({});
    };
    const surface = canvas.transferControlToOffscreen();
    this.worker.postMessage({ canvas: surface, told: {}, view: this.view }, [surface]);
    this.sent = performance.now();
    const look = () => canvas.clientWidth && this.send({ view: this.view });
    controls.addEventListener("change", look);
    new ResizeObserver(look).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.show(JSON.parse(this.told), true));
  }

  get view() {
    const { camera, controls: { target }, canvas } = this;
    return { eye: camera.position.toArray(), target: target.toArray(), width: canvas.clientWidth || 300, height: canvas.clientHeight || 150, ratio: devicePixelRatio };
  }

  // Draw another robot, from what the agent told of it.
  show(told, isAgain = false) {
    const text = JSON.stringify(told), style = getComputedStyle(this.canvas);
    if (text === this.told && !isAgain) return;
    Object.assign(this, { told: text, way: [] });
    this.send({ told, colours: Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()])) });
  }

  add({ tool }) {
    if (tool?.every((value) => value !== null)) this.way = [...this.way.slice(1 - TRAIL), tool];
  }

  draw(telemetry) {
    if (this.sent === null && performance.now() >= this.rested) this.send({ telemetry, way: this.way });
  }

  // What changed goes to the worker once that has drawn what went before.
  send(changed) {
    Object.assign(this.next, changed);
    if (this.sent !== null) return;
    this.worker.postMessage(this.next);
    Object.assign(this, { next: {}, sent: performance.now() });
  }
}
