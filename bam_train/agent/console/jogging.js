// Jogging: what is held down (keys, buttons, a gamepad) becomes a twist, sent 20 times a second while it is held.
// Nothing counts as held once the page is not in front, or was frozen; the robot's side ends a twist after 0.2 s anyway.

const PERIOD = 50; // between two twists [ms]
const FROZEN = 250; // a gap between two looks from which on everything counts as released [ms]
// The keys, for bam-play too; moves: name: [keys, vx, vy, vz, wz, gripper, whether a base has it, or "sideways"]; m/s, rad/s.
export const KEYS = await (await fetch("keys.json")).json();
const { moves: MOVES, turn: TURN } = KEYS;
const { dead: DEAD, enable: ENABLE, stop: STOP, close: CLOSE, open: OPEN } = KEYS.gamepad;
const BY_KEY = new Map(Object.entries(MOVES).flatMap(([name, [keys]]) => keys.map((key) => [key, name])));

export class Jogging {
  // send(message): whether it went out; changed(names): what is held; stop(): a gamepad's stop button.
  constructor(pads, send, changed, stop) {
    Object.assign(this, { send, changed, stop });
    this.held = new Map(); // how it is held (a key, a pointer) -> name of the move
    this.active = false;
    this.isBase = this.sideways = false;
    this.speed = KEYS.speed;
    this.seq = 0;
    this.moved = false;
    this.stopHeld = false;
    this.look = performance.now();
    addEventListener("keydown", (event) => this.down(event));
    addEventListener("keyup", (event) => this.let(event.code));
    for (const name of ["blur", "pagehide", "freeze"]) addEventListener(name, () => this.release());
    document.addEventListener("visibilitychange", () => this.release());
    document.addEventListener("freeze", () => this.release());
    for (const name of Object.keys(MOVES)) pads.append(this.pad(name));
    this.pads = pads;
    setInterval(() => this.tick(), PERIOD);
  }

  pad(name) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = `${name} (${MOVES[name][0][0].replace("Key", "")})`;
    button.dataset.move = name;
    button.onpointerdown = (event) => {
      if (event.button === 0) this.hold(`pointer ${event.pointerId}`, name);
    };
    for (const end of ["pointerup", "pointercancel", "pointerleave", "lostpointercapture"]) {
      button.addEventListener(end, (event) => this.let(`pointer ${event.pointerId}`));
    }
    button.oncontextmenu = (event) => event.preventDefault();
    return button;
  }

  // Of a base, and whether it drives sideways; else of an arm.
  start(isBase, sideways) {
    Object.assign(this, { active: true, isBase, sideways });
    const has = sideways ? [true, "sideways"] : [true];
    for (const pad of this.pads.children) pad.hidden = isBase && !has.includes(MOVES[pad.dataset.move][6]);
  }

  end() {
    this.release();
    this.active = false;
  }

  down(event) {
    const name = BY_KEY.get(event.code);
    if (event.metaKey || event.ctrlKey || event.altKey) {
      this.release(); // such keys swallow the release of others
    } else if (this.active && name !== undefined) {
      event.preventDefault();
      if (!event.repeat) this.hold(event.code, name);
    }
  }

  hold(how, name) {
    if (!this.active) return;
    this.held.set(how, name);
    this.tick();
    this.changed([...this.held.values()]);
  }

  let(how) {
    if (!this.held.delete(how)) return;
    this.tick();
    this.changed([...this.held.values()]);
  }

  release() {
    const any = this.held.size > 0 || this.moved;
    this.held.clear();
    if (!any) return;
    this.sendTwist([0, 0, 0, 0], 0);
    this.moved = false;
    this.changed([]);
  }

  tick() {
    const now = performance.now();
    if (now - this.look > FROZEN) this.release();
    this.look = now;
    const inFront = document.visibilityState === "visible" && document.hasFocus();
    const pad = inFront ? [...navigator.getGamepads()].find((one) => one?.mapping === "standard") : null;
    const wantsStop = Boolean(pad?.buttons[STOP].pressed);
    if (wantsStop && !this.stopHeld) this.stop();
    this.stopHeld = wantsStop;
    if (!this.active) return;
    const twist = [0, 0, 0, 0, 0];
    for (const name of new Set(this.held.values())) {
      MOVES[name].slice(1, 6).forEach((value, at) => (twist[at] += value));
    }
    const [x, y, z, turn, grip] = twist;
    let move = [x * this.speed, y * this.speed, z * this.speed, turn * TURN];
    let gripper = Math.sign(grip);
    const enabled = Boolean(pad?.buttons[ENABLE].pressed);
    if (enabled) {
      const stick = pad.axes.map((value) => (Math.abs(value) < DEAD ? 0 : value));
      move = [-stick[1] * this.speed, -stick[0] * this.speed, -stick[3] * this.speed, -stick[2] * TURN];
      gripper = pad.buttons[CLOSE].pressed - pad.buttons[OPEN].pressed;
    }
    if (this.held.size > 0 || enabled) {
      this.sendTwist(move, gripper);
      this.moved = true;
    } else if (this.moved) {
      this.sendTwist([0, 0, 0, 0], 0);
      this.moved = false;
    }
  }

  sendTwist([x, y, z, turn], gripper) {
    const twist = this.isBase ? [x, this.sideways ? y : 0, 0] : [x, y, z];
    const length = Math.sqrt(twist[0] * twist[0] + twist[1] * twist[1] + twist[2] * twist[2]); // as Python's, bit for bit
    const share = length > this.speed ? this.speed / length : 1;
    this.send({ op: "jog", seq: this.seq++, sent: performance.now() / 1000, twist: [...twist.map((v) => v * share), turn], gripper });
  }
}
