// Charts of the last 30 s, by uPlot. Lines differ by their dashes, not by their colour alone.

const SPAN = 30; // [s]
const HEIGHT = 150; // of a chart, without its legend [pixels]
const LINES = [ // colour, dashes, and the dashes in the legend
  ["#2b7de9", [], "──"], ["#c25a10", [8, 4], "╌╌"], ["#1c8a4a", [2, 3], "···"],
  ["#b541b0", [10, 3, 2, 3], "─·"], ["#0f8797", [16, 3, 2, 3, 2, 3], "─··"], ["#d64550", [2, 8], "· · "],
];

export class Plots {
  constructor(parent) {
    this.parent = parent;
    this.charts = new Map(); // name of a signal -> {chart, rows: [time, values…]}
    this.end = -Infinity;
    if (!window.uPlot) parent.textContent = "The library that draws the charts is missing: install bam-train again, with a link to the npm registry.";
  }

  add({ t, state, units, tool }) {
    if (!window.uPlot) return;
    if (t <= this.end) for (const { rows } of this.charts.values()) rows.length = 0; // another robot, or its clock was set
    this.end = t;
    const [x, y, z] = tool ?? [];
    for (const [name, values] of Object.entries({ ...(tool && { tool: { x, y, z } }), ...state })) {
      const labels = Object.keys(values);
      if (labels.length > LINES.length) continue;
      if (!this.charts.has(name)) this.charts.set(name, this.chart(name, labels, [...new Set(Object.values(units[name] ?? ["m"]))]));
      const { rows } = this.charts.get(name);
      rows.push([t, ...Object.values(values)]);
      while (rows[0][0] < t - SPAN) rows.shift();
    }
  }

  chart(name, labels, units) {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    const style = getComputedStyle(document.documentElement), colour = (variable) => () => style.getPropertyValue(variable);
    const axis = { stroke: colour("--quiet"), grid: { stroke: colour("--hair"), width: 1 }, ticks: { show: false }, font: "12px system-ui, sans-serif", size: 26 };
    const room = (chart, low, high) => [low - Math.max(0.05 * (high - low), 0.01), high + Math.max(0.05 * (high - low), 0.01)];
    const value = (chart, number) => number?.toFixed(3) ?? "-";
    const lines = labels.map((label, at) => ({ label: `${LINES[at][2]} ${label.replace(/_joint$|^object_/, "")}`, stroke: LINES[at][0], dash: LINES[at][1], width: 2, points: { show: false }, value }));
    caption.textContent = `${name.replaceAll("_", " ")} [${units.join(", ")}]`;
    figure.append(caption);
    this.parent.append(figure);
    const chart = new uPlot({
      width: figure.clientWidth, height: HEIGHT,
      cursor: { drag: { x: false, y: false }, sync: { key: "charts" }, y: false },
      scales: { x: { time: false, range: [-SPAN, 0] }, y: { range: room } },
      axes: [{ ...axis, values: (_, at) => at.map((one) => `${one} s`) }, { ...axis, size: 52 }],
      series: [{}, ...lines],
    }, [[], ...labels.map(() => [])], figure);
    Object.assign(chart.ctx.canvas, { role: "img", ariaLabel: `${name} over the last ${SPAN} s` });
    new ResizeObserver(() => chart.setSize({ width: figure.clientWidth, height: HEIGHT })).observe(figure);
    return { chart, rows: [] };
  }

  draw() {
    for (const { chart, rows } of this.charts.values()) {
      chart.setData(chart.series.map((_, at) => rows.map((row) => (at ? row[at] : row[0] - this.end))));
      if (chart.cursor.idx == null) chart.setLegend({ idx: rows.length - 1 });
    }
  }
}
