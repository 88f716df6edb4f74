// What the status says, in words: the text of every panel.

const ICONS = {
  "waiting for the robot": "…", "paused": "❚❚", "running": "▶", "trial": "◔", "taken over": "⇄", "stopped by a guard": "✖",
};
export const byId = (id) => document.getElementById(id);
const short = (digest) => (digest ? digest.slice(0, 12) : "-");
const BUSY = 50; // a drawing that takes longer, with its wait for the screen, shows that this computer is busy [ms]
const GIVE_WAY = 4; // then the next one waits for so many times as long, so that buttons and keys are heard at once
const LONGEST_WAIT = 1000; // at most [ms]
export const restAfter = (took) => (took > BUSY ? Math.min(GIVE_WAY * took, LONGEST_WAIT) : 0);
export const MISSING = "The robot is not drawn: the library for that did not come. Reload the page; if that does not help, install bam-train again, with a link to the npm registry.";
const NEAR = 0.8; // share of a limit from which on a guard is said to be near

// Text only where it changed: a screen reader announces every change.
export function say(id, text) {
  const place = byId(id);
  if (place.textContent !== text) place.textContent = text;
}

function element(kind, text, children = []) {
  const made = document.createElement(kind);
  if (text !== null) made.textContent = text;
  made.append(...children);
  return made;
}

function rows(table, head, lines) {
  const cells = (kind, line) => element("tr", null, line.map((text) => element(kind, String(text))));
  table.replaceChildren(cells("th", head), ...lines.map((line) => cells("td", line)));
}

const duration = (seconds) => (seconds < 90 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`);

export function showStatus(status, mine) {
  const kind = status.simulated == null ? "" : status.simulated ? "simulated" : "real";
  say("name", status.name || "Robot console");
  say("robot", [kind, status.robot, status.address].filter((text, at, all) => text && all.indexOf(text) === at).join(" · "));
  say("state", `${ICONS[status.state] ?? "○"} ${status.state}`);
  document.body.dataset.state = status.state;
  say("why", status.why ? `${status.why}` : "");
  const until = status.owner_until == null ? "" : `; the lease ends in ${status.owner_until.toFixed(0)} s unless it is used`;
  say("owner", mine ? `You drive${until}.` : status.owner ? `${status.owner} drives${until}.` : "");
  document.title = `${status.state} - ${status.name || "robot console"}`;
  showRun(status);
  showGuardTable(status.guards ?? {});
  byId("warnings").replaceChildren(...(status.warnings ?? []).map((text) => element("li", `⚠ ${text}`)));
}

function showRun(status) {
  const recent = status.recent ?? [], judged = recent.filter((one) => one !== null), good = judged.filter(Boolean).length;
  const rate = judged.length ? `${good} of ${judged.length} (${Math.round((100 * good) / judged.length)} %)` : "none judged yet";
  const ms = (value) => (value == null ? "-" : `${value.toFixed(1)} ms`);
  const facts = {
    "Active version": [Object.keys(status.names ?? {}).filter((name) => status.names[name] === status.active).join(", "), short(status.active)].join(" "),
    "Stage": [...new Set([status.stage ?? "-", ...(status.marks ?? [])])].join(", "),
    "Environment": status.env ?? "-",
    "Success, last 20 episodes": rate,
    "Trials of the candidate": status.trial ? `${status.trial.done} of ${status.trial.needed}` : "-",
    "Episodes": `${status.episodes ?? 0}, step ${status.steps ?? 0} of this one`,
    "Link latency": ms(status.link_ms),
    "Loop latency": `${ms(status.loop_ms)} of ${ms(status.period == null ? null : 1000 * status.period)}`,
    "Late ticks": `${status.late ?? 0} of ${status.ticks ?? 0}${status.slow ? `, ${status.slow} because of the policy` : ""}`,
    "In this state for": status.since ? duration(Date.now() / 1000 - status.since) : "-",
    "Recording": status.recording ?? "none",
    "Software": status.agent ? `bam-train ${status.agent}` : "-",
  };
  byId("run").replaceChildren(...Object.entries(facts).flatMap(([name, text]) => [element("dt", name), element("dd", text)]));
  const signs = recent.map((one) => (one === null ? "·" : one ? "✓" : "✗")).join(" ");
  say("recent", recent.length ? `Oldest to newest: ${signs}  (✓ success, ✗ no success, · not judged)` : "");
}

function showGuardTable(guards) {
  const lines = Object.entries(guards).map(([name, row]) => {
    const limit = row.limit == null ? "off" : `${Number(row.limit.toPrecision(3))} ${row.unit}`;
    return [`${name} (${row.number})`, limit, row.altered, row.held, row.stopped];
  });
  rows(byId("guard-table"), ["Guard", "Limit", "Altered", "Held", "Stopped"], lines);
}

// Bars: how near the guards are that the newest state can be compared with, the nearest first.
export function showNear(near, guards) {
  const list = byId("guards"), names = Object.keys(near);
  if (list.dataset.names !== names.join()) {
    list.dataset.names = names.join();
    list.replaceChildren(...names.map((name) => {
      const bar = element("progress", null);
      bar.max = 1;
      bar.setAttribute("aria-label", name);
      return element("li", null, [element("span", ""), element("span", ""), bar, element("small", "")]);
    }));
  }
  names.forEach((name, at) => {
    const { value, limit, unit, share } = near[name], counts = guards[name];
    const [title, number, bar, acted] = list.children[at].children;
    title.textContent = `${share >= 1 ? "✖ at its limit:" : share >= NEAR ? "⚠ near:" : "✓"} ${name}`;
    number.textContent = `${value.toPrecision(3)} ${unit}, limit ${Number(limit.toPrecision(3))}`;
    acted.textContent = ["altered", "held", "stopped"].filter((did) => counts?.[did]).map((did) => `${did} ${counts[did]}`).join(", ");
    list.children[at].classList.toggle("near", share >= NEAR);
    bar.value = share;
  });
}

export function showTelemetry({ tool, base, state }) {
  const at = (values, unit) => values.map((value) => value.toFixed(3)).join(", ") + ` ${unit}`;
  const width = state.gripper_width?.gripper_width, gripper = width == null ? "" : `; gripper open by ${(1000 * width).toFixed(0)} mm`;
  say("tool", tool ? `Tool at x, y, z: ${at(tool, "m")}${gripper}` : base ? `Base at x, y: ${at(base.slice(0, 2), "m")}, yaw ${base[2].toFixed(2)} rad` : "");
  say("legend", `${base ? "Blue: its front, and what its scanners see; green: where it goes" : "Line: the tool's way; dashed: its workspace; red, green, blue: x, y, z"}. Drag to turn, scroll or pinch to zoom.`);
}

export function showVersions(versions, status) {
  const lines = versions.map(({ digest, names, added, env, algorithm }) => [
    digest === status.active ? "▶ acts" : "", names?.join(", ") || "-", short(digest), time(added), env ?? "-", algorithm ?? "-",
  ]);
  rows(byId("versions"), ["", "Names", "Digest", "Added", "Environment", "Algorithm"], lines);
}

const time = (value) => {
  const date = new Date(typeof value === "number" ? 1000 * value : value);
  return Number.isNaN(date.getTime()) ? "-" : date.toLocaleString();
};

export function showAudit(lines) {
  const from = ({ who, where }) => (where ? `${who} at ${where}` : who);
  const text = (line) => `${time(line.time)}  ${line.text} (${from(line)})`;
  byId("audit").replaceChildren(...[...lines].reverse().map((line) => element("li", text(line))));
}
