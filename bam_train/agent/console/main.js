// The console: one socket for status and orders, one for pictures; the buttons, and the space bar, which always stops.

import { showCameras } from "./cameras.js";
import { Connection } from "./connection.js";
import { Jogging, KEYS } from "./jogging.js";
import { MISSING, byId, restAfter, say, showAudit, showNear, showStatus, showTelemetry, showVersions } from "./panels.js";
import { Plots } from "./plots.js";

const DRAWS = ["scene.js", "three.core.min.js", "three.module.min.js", "OrbitControls.js"]; // asked for at once, for a slow network
const LOOK = 2000; // time between two looks at versions and log [ms]
const OLD = 1000; // age of the newest state from which on the page says that it is old [ms]
const WRITE = 250; // least time between two sets of plots and numbers [ms]
let status = { state: "not connected" };
let telemetry = null;
let heard = -Infinity; // when it came
let written = -Infinity; // when plots and numbers were drawn
let asked = null; // when the drawing that comes was asked for
let rested = -Infinity; // until when drawings give way
let role = "watch"; // what this page's token may do
let owner = null; // how the status calls this page while it drives; "" until it says so; null: it does not drive
let cameras = null;
let picture = null; // once its library has come, after everything that stops the robot
let scene = {}; // what it is drawn from
let undrawn = ""; // why there is none

const connection = new Connection("/agent", { open: connected, lost, event, token: askToken });
const plots = new Plots(byId("plots"));
// A twist is not sent while the network is stuck: it would arrive too late.
const send = (twist) => connection.socket.bufferedAmount > 2000 || connection.send(twist);
const held = (names) => say("jog-state", names.length ? `Moving: ${names.join(", ")}` : "Hold a key or button to move the robot.");
const jogging = new Jogging(byId("pads"), send, held, stop);

// ---- the connection

function connected() {
  connection.request("watch", { on: true }).then(entered, fault);
  connection.request("status").then((newest) => {
    if (status.state === "not connected") show(newest); // the first event may come later than the first image
  }, fault);
}

function entered(watched) {
  scene = watched.scene;
  for (const href of picture ? [] : DRAWS) document.head.append(Object.assign(document.createElement("link"), { rel: "modulepreload", href }));
  import("./picture.js").then(begin, () => noPicture(MISSING));
  byId("entry").hidden = true;
  byId("main").hidden = false;
  say("link", "");
  fault("");
  look();
  cameras ??= showCameras(byId("cameras"));
  cameras.again();
}

function begin({ Picture }) {
  if (picture === null) undrawn = "";
  picture ??= new Picture(byId("picture"), noPicture);
  picture.show(scene);
}

function noPicture(why = undrawn) {
  undrawn = why;
  const shown = why || (scene.placements || telemetry?.base || !telemetry ? "" : "This robot's shape is not known; see its numbers.");
  say("no-picture", shown);
  byId("picture").hidden = byId("legend").hidden = Boolean(shown);
}

function lost(reason) {
  endDriving();
  show({ ...status, state: "not connected", why: "", owner: null });
  say("link", `⚠ No connection to the robot${reason ? ` (${reason})` : ""}; trying again. STOP does not reach it now.`);
  enable();
}

function askToken(reason) {
  say("link", "");
  say("entry-reason", reason);
  if (byId("entry").hidden) {
    byId("entry").hidden = false;
    byId("main").hidden = true;
    byId("token").focus();
  }
}

byId("entry").onsubmit = (submit) => {
  submit.preventDefault();
  sessionStorage.setItem("person", byId("person").value.trim());
  const token = byId("token").value.trim();
  byId("token").value = "";
  byId("entry-reason").textContent = "…";
  connection.enter(token);
};

function event(message) {
  if (message.event === "hello") {
    role = message.role;
  } else if (message.event === "status") {
    show(message.status);
  } else if (message.event === "telemetry") {
    telemetry = message;
    heard = performance.now();
    plots.add(message);
    picture?.add(message);
    if (asked === null && heard >= rested) {
      asked = heard;
      requestAnimationFrame(draw);
    }
  } else if (message.ok === false) {
    fault(message.error); // of a twist
  }
}

function show(newest) {
  const before = status;
  status = newest;
  if (owner === "" && status.state === "taken over") owner = status.owner;
  if (owner && (status.state !== "taken over" || status.owner !== owner)) endDriving();
  showStatus(status, owner !== null);
  enable();
  if (before.active !== status.active || before.state !== status.state) look();
}

function draw() {
  const now = performance.now();
  try {
    noPicture();
    picture?.draw({ ...telemetry, goals: status.goals ?? [] });
    if (now - written < WRITE) return;
    written = now;
    plots.draw();
    showTelemetry(telemetry);
    showNear(telemetry.near ?? {}, status.guards ?? {});
  } finally {
    rested = performance.now() + restAfter(performance.now() - asked);
    asked = null;
  }
}

setInterval(() => {
  const old = performance.now() - heard;
  byId("picture").classList.toggle("old", old > OLD);
  if (old > OLD) say("tool", Number.isFinite(old) ? `⚠ Old: no state of the robot came for ${Math.round(old / 1000)} s.` : "");
}, 500);

function look() {
  if (!connection.ready || document.visibilityState !== "visible") return;
  connection.request("versions").then(({ versions }) => showVersions(versions, status)).catch(() => {});
  connection.request("audit").then((result) => showAudit(result.lines)).catch(() => {});
}
setInterval(look, LOOK);

function fault(error) {
  byId("error").hidden = !error;
  say("error", error ? `⚠ ${error.message ?? error}` : "");
}

// ---- orders

// The result of a request, or undefined if it was refused, which the page says.
function order(op, fields) {
  fault("");
  return connection.request(op, fields).catch(fault);
}

function stop() {
  jogging.release();
  const sent = performance.now();
  say("stop-note", "Stop sent …");
  connection.request("stop").then(
    () => say("stop-note", `Stopped. The robot's side answered after ${(performance.now() - sent).toFixed(0)} ms.`),
    (error) => say("stop-note", `⚠ STOP did not arrive: ${error.message} Use the emergency stop.`),
  );
}

byId("stop").addEventListener("pointerdown", (press) => {
  if (press.button !== 0) return;
  press.preventDefault();
  stop();
});
byId("stop").addEventListener("click", (click) => {
  if (click.detail === 0) stop(); // by the keyboard, or by an aid; the pointer has stopped already
});

// The space bar stops, whatever has the focus, except while a text is typed.
for (const name of ["keydown", "keyup"]) {
  addEventListener(name, (key) => {
    if (key.code !== "Space" || key.target.matches?.("input:not([type=button])")) return;
    key.preventDefault();
    key.stopImmediatePropagation();
    if (name === "keydown" && !key.repeat) stop();
  }, { capture: true });
}

for (const op of ["pause", "resume"]) byId(op).onclick = () => order(op);
for (const [id, resume] of [["back-run", true], ["back-pause", false]]) {
  byId(id).onclick = () => {
    endDriving();
    order("hand_back", { resume });
  };
}
byId("take").onclick = async () => {
  const force = Boolean(status.owner) && owner === null;
  if (force && !(await ask(`${status.owner} drives this robot. Take it by force?`))) return;
  const result = await order("take", { force });
  if (result === undefined) return;
  owner = result.owner ?? "";
  jogging.start(Boolean(telemetry?.base), "lateral_velocity" in (telemetry?.state?.base_velocity ?? {}));
  byId("jog").hidden = false;
  showStatus(status, true);
  enable();
};
byId("roll-back").onclick = async () => {
  const { active, names: { champion } = {} } = status, target = champion && champion !== active ? "champion" : "version before";
  if (await ask(`Roll back to the ${target}?`)) await order("rollback");
  look();
};

function ask(text) {
  const dialog = byId("question");
  say("question-text", text);
  dialog.showModal();
  return new Promise((resolve) => {
    // Not by the event that it closed, which may come once the next question is there.
    for (const [id, answer] of [["yes", true], ["no", false]]) byId(id).onclick = () => { dialog.close(); resolve(answer); };
    dialog.oncancel = () => resolve(false);
  });
}

function enable() {
  const { state, active, names: { champion, previous } = {} } = status;
  const mine = owner !== null, here = state !== "not connected" && role !== "watch";
  const may = {
    "pause": here && (state === "running" || state === "trial" || mine || state === "stopped by a guard"),
    "resume": here && !mine && (state === "paused" || state === "stopped by a guard"),
    "take": here && !mine && !["waiting for the robot", "stopped by a guard"].includes(state),
    "back-run": mine,
    "back-pause": mine,
    "roll-back": here && role === "administer" && Boolean(previous || (champion && champion !== active)), // from a candidate, to the champion
  };
  for (const [id, enabled] of Object.entries(may)) byId(id).disabled = !enabled;
}

// ---- driving

function endDriving() {
  owner = null;
  jogging.end();
  byId("jog").hidden = true;
}

byId("speed").onclick = () => {
  jogging.speed = KEYS.speeds[(KEYS.speeds.indexOf(jogging.speed) + 1) % KEYS.speeds.length];
  byId("speed").textContent = `Speed ${jogging.speed.toFixed(2)} m/s`;
};
addEventListener("gamepadconnected", () => say("gamepad", "Gamepad: hold the right shoulder button, move the sticks; A closes, Y opens, B stops."));
addEventListener("gamepaddisconnected", () => { jogging.release(); say("gamepad", "Gamepad: none."); });

enable();
