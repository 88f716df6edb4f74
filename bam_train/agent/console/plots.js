// Plots of the last 30 s. Lines differ by their dashes and by a number at their end, not by their colour alone.

import { cleared } from "./picture.js";

const SPAN = 30; // [s]
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3], [14, 6], [4, 8]];
const HUES = [212, 28, 130, 285, 0, 175];

export class Plots {
  constructor(parent) {
    this.parent = parent;
    this.rows = []; // [time, {name of the plot: [values]}]
    this.plots = new Map(); // name -> {canvas, text, labels, unit}
  }

  add({ t, state, units, tool }) {
    const values = {};
    if (tool) values.tool = this.plot("tool", ["x", "y", "z"], "m") && tool;
    for (const [signal, numbers] of Object.entries(state)) {
      const labels = Object.keys(numbers);
      if (labels.length > DASHES.length) continue;
      this.plot(signal, labels, [...new Set(Object.values(units[signal]))].join(", "));
      values[signal] = Object.values(numbers);
    }
    if (this.rows.length && t <= this.rows.at(-1)[0]) this.rows = []; // another robot, or its clock was set
    this.rows.push([t, values]);
    while (this.rows[0][0] < t - SPAN) this.rows.shift();
  }

  plot(name, labels, unit) {
    if (this.plots.has(name)) return true;
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    const canvas = document.createElement("canvas"), text = document.createElement("span");
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `${name} over the last ${SPAN} s`);
    caption.append(`${name.replaceAll("_", " ")} [${unit}] `, text);
    figure.append(caption, canvas);
    this.parent.append(figure);
    this.plots.set(name, { canvas, text, labels });
    return true;
  }

  draw() {
    const end = this.rows.at(-1)?.[0];
    if (end === undefined) return;
    const captions = []; // written last: a written text makes the next look at a size slow
    for (const [name, { canvas, text, labels }] of this.plots) {
      const rows = this.rows.filter(([, values]) => values[name]).map(([t, values]) => [t, values[name]]);
      const [context, width, height] = cleared(canvas);
      if (!rows.length || width === 0) continue;
      const every = rows.flatMap(([, values]) => values).filter((value) => value !== null);
      const low = Math.min(...every), high = Math.max(...every), room = Math.max(0.05 * (high - low), 0.01);
      const y = (value) => height - 6 - ((value - low + room) / (high - low + 2 * room)) * (height - 12);
      const x = (t) => (width - 22) * (1 - (end - t) / SPAN);
      context.font = "12px system-ui, sans-serif";
      context.fillStyle = getComputedStyle(canvas).color;
      context.fillText(high.toFixed(2), 2, 12);
      context.fillText(low.toFixed(2), 2, height - 3);
      labels.forEach((label, at) => {
        context.strokeStyle = `hsl(${HUES[at]} 70% 50%)`;
        context.lineWidth = 2;
        context.setLineDash(DASHES[at]);
        context.beginPath();
        for (const [t, values] of rows) if (values[at] !== null) context.lineTo(x(t), y(values[at]));
        context.stroke();
        const last = rows.at(-1)[1][at];
        if (last !== null) context.fillText(at + 1, width - 18 + 9 * (at % 2), y(last) + 4);
      });
      const newest = rows.at(-1)[1];
      const numbers = labels.map((label, at) => `${at + 1} ${label.replace("_joint", "")} ${newest[at]?.toFixed(3) ?? "-"}`);
      captions.push([text, numbers.join(" · ")]);
    }
    for (const [text, caption] of captions) text.textContent = caption;
  }
}
