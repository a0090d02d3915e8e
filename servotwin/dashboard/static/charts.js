// Plots: uPlot over time, in the colours of the theme; and a loop in the plane, which uPlot does not draw.

/* global uPlot */
import { colour, element, svg } from "./dom.js";
import { brief, fixed } from "./format.js";

// Sizes follow that of the page's text.
const rem = () => parseFloat(getComputedStyle(document.documentElement).fontSize) / 16;

function axis(label, size, more = {}) {
  const font = `${Math.round(12 * rem())}px system-ui, sans-serif`;
  return {
    label, labelFont: font, font, labelSize: 18 * rem(), stroke: colour("soft"), size: size * rem(),
    grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("grid"), width: 1 }, ...more,
  };
}

// Vertical marks with a word each, drawn behind the data; words that would overlap are left out.
function marks(list) {
  return (plot) => {
    const { ctx, bbox } = plot;
    ctx.save();
    const unit = devicePixelRatio * rem();
    ctx.font = `${11 * unit}px system-ui, sans-serif`;
    let free = -Infinity;
    for (const { at, word, color, dash } of list()) {
      const x = plot.valToPos(at, "x", true);
      if (x < bbox.left || x > bbox.left + bbox.width) continue;
      ctx.strokeStyle = ctx.fillStyle = colour(color);
      ctx.lineWidth = devicePixelRatio;
      ctx.setLineDash(dash ? [4, 4] : []);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      const width = ctx.measureText(word).width;
      if (x > free && x + width < bbox.left + bbox.width) {
        ctx.fillText(word, x + 3 * unit, bbox.top + 11 * unit);
        free = x + width + 8 * unit;
      }
    }
    ctx.restore();
  };
}

/* A plot over time that follows the width of its place.
   options: height, time (x is s since the epoch), xLabel, yLabel, series [{label, color, width, dash, points, paths}],
   bands [[high, low, color]], marks () => [{at, word, color, dash}], range (low, high) => [low, high], sync, about,
   moving: the newest data come by themselves, so that nobody looks closer. */
export class TimePlot {
  constructor(place, options) {
    Object.assign(this, { place, options, data: null });
    place.setAttribute("role", "img");
    if (!options.moving) {
      place.tabIndex = 0;
      place.addEventListener("keydown", (event) => this.key(event));
    }
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(place);
  }

  show(data, about) {
    this.data = data;
    this.place.setAttribute("aria-label", about);
    if (this.plot) this.plot.setData(data);
    else this.make();
    this.surround();
    this.relabel();
  }

  make() {
    const { options } = this;
    const width = this.place.clientWidth;
    if (!width || !this.data) return;
    this.width = width;
    this.rem = rem();
    this.plot = new uPlot({
      width, height: this.place.clientHeight || 240,
      legend: { show: false },
      cursor: { sync: options.sync ? { key: options.sync } : undefined, drag: { x: true, y: false } },
      scales: { x: { time: Boolean(options.time) }, y: { range: (_, low, high) => this.range(low, high) } },
      axes: [
        axis(options.xLabel, options.time ? 46 : 34, { space: (options.time ? 75 : 52) * rem(), values: options.time ? [...TIME_FORMATS] : undefined }),
        axis(options.yLabel, 72, { size: (_, ticks) => widthOf(ticks), space: 30 * rem(), values: (_, ticks) => ticks.map((tick) => (tick === null || this.empty ? "" : tickText(tick, ticks))) }),
      ],
      series: [{}, ...options.series.map((each) => ({
        label: each.label, stroke: colour(each.color), width: each.width ?? 1.6, dash: each.dash, spanGaps: Boolean(each.spanGaps),
        points: { show: Boolean(each.points), size: 6, fill: each.hollow ? colour("raised") : colour(each.color), stroke: colour(each.color) },
        paths: each.only ? () => null : each.steps ? uPlot.paths.stepped({ align: 1 }) : undefined,
      }))],
      bands: (options.bands ?? []).map(([high, low, color]) => ({ series: [high, low], fill: translucent(colour(color)) })),
      hooks: options.marks ? { drawClear: [marks(options.marks)] } : {},
    }, this.data, this.place);
    this.plot.root.setAttribute("aria-hidden", "true");
  }

  // Without a range uPlot leaves out the axis, and all would move when the first data come.
  range(low, high) {
    this.empty = low === null;
    if (this.empty) return [0, 1];
    return this.options.range ? this.options.range(low, high) : uPlot.rangeNum(low, high, 0.1, true);
  }

  // As dragging does with a mouse: + and - look closer and less close, arrows move, 0 and Escape show all.
  key(event) {
    const zoom = ZOOM[event.key], move = MOVE[event.key];
    if (!(zoom || move) || !this.plot || !this.data[0].length || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    const { min, max } = this.plot.scales.x, first = this.data[0][0], last = this.data[0].at(-1);
    const shift = Math.min(last - max, Math.max(first - min, (move ?? 0) * (max - min))), half = ((zoom ?? 1) * (max - min)) / 2;
    const x = { min: Math.max(first, (min + max) / 2 + shift - half), max: Math.min(last, (min + max) / 2 + shift + half) };
    for (const plot of this.options.sync ? uPlot.sync(this.options.sync).plots : [this.plot]) plot.setScale("x", x);
  }

  resize() {
    if (!this.plot) {
      this.make();
      return this.surround();
    }
    const width = this.place.clientWidth;
    if (this.rem !== rem()) return this.redraw(); // on another screen: fonts are fixed when a plot is made
    if (width && width !== this.width) {
      this.width = width;
      this.plot.setSize({ width, height: this.place.clientHeight || 240 });
    }
  }

  // Labels are fixed when a plot is made.
  relabel() {
    if (this.plot && this.plot.axes[1].label !== this.options.yLabel) this.redraw();
  }

  redraw() {
    this.plot?.destroy();
    this.plot = null;
    this.make();
    this.surround();
  }

  // About a single time uPlot shows a thousand days; two minutes are enough.
  surround() {
    const [at] = this.data?.[0] ?? [];
    if (this.plot && this.options.time && this.data[0].length === 1) this.plot.setScale("x", { min: at - 60, max: at + 60 });
  }

  close() {
    this.observer.disconnect();
    this.plot?.destroy();
  }
}

const ZOOM = { "+": 0.5, "=": 0.5, "-": 2, 0: 1e12, Escape: 1e12 }, MOVE = { ArrowLeft: -0.25, ArrowRight: 0.25 };

// Times of day in 24 hours, the day where it changes.
const TIME_FORMATS = [
  [86400 * 365, "{YYYY}", null, null, null, null, null, null, 1],
  [86400 * 28, "{YYYY}-{MM}", null, null, null, null, null, null, 1],
  [86400, "{MM}-{DD}", "\n{YYYY}", null, null, null, null, null, 1],
  [60, "{HH}:{mm}", "\n{YYYY}-{MM}-{DD}", null, "\n{YYYY}-{MM}-{DD}", null, null, null, 1],
  [1, "{HH}:{mm}:{ss}", "\n{YYYY}-{MM}-{DD}", null, null, null, null, null, 1],
  [0.001, ":{ss}.{fff}", "\n{HH}:{mm}", null, null, null, null, null, 1],
];

// Of an axis with these labels: of one width up to seven characters; a longer number does not reach into the axis's name.
const widthOf = (labels) => Math.max(72, 27 + 6.4 * Math.max(0, ...(labels ?? []).map((each) => (each ?? "").length))) * rem();

// As many decimals as the distance of two ticks needs.
export function tickText(tick, ticks) {
  const step = Math.abs(ticks[1] - ticks[0]) || 1;
  let decimals = 0;
  const whole = (size) => Math.abs(size - Math.round(size)) <= 1e-6 * size;
  while (decimals < 9 && !whole(step * 10 ** decimals)) decimals++;
  return fixed(tick, decimals);
}

const translucent = (color) => color.replace(/^rgb\((.*)\)$/, "rgba($1, 0.22)");

// A loop in the plane: y over x with axes; points in their order.
export function loopPlot(x, y, { xLabel, yLabel, about }) {
  const W = 400, H = 320, left = 64, right = 12, top = 10, bottom = 44;
  const [x0, x1] = extent(x), [y0, y1] = extent(y);
  const px = (value) => left + ((value - x0) / (x1 - x0)) * (W - left - right);
  const py = (value) => H - bottom - ((value - y0) / (y1 - y0)) * (H - top - bottom);
  const node = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": about });
  const line = (d, stroke, width) => svg("path", { d, fill: "none", stroke, "stroke-width": width });
  const across = ticksOf(x0, x1), up = ticksOf(y0, y1);
  for (const tick of across) {
    node.append(line(`M${px(tick)} ${top}V${H - bottom}`, "var(--grid)", 1), text(tickText(tick, across), px(tick), H - bottom + 16, "middle"));
  }
  for (const tick of up) {
    node.append(line(`M${left} ${py(tick)}H${W - right}`, "var(--grid)", 1), text(tickText(tick, up), left - 6, py(tick) + 4, "end"));
  }
  const d = x.map((value, i) => `${i ? "L" : "M"}${px(value).toFixed(1)} ${py(y[i]).toFixed(1)}`).join("");
  node.append(line(d, "var(--blue)", 1.4), text(xLabel, (left + W - right) / 2, H - 8, "middle"));
  const side = text(yLabel, 0, 0, "middle");
  side.setAttribute("transform", `translate(13 ${(top + H - bottom) / 2}) rotate(-90)`);
  node.append(side);
  return node;
}

const text = (words, x, y, anchor) => svg("text", { x, y, "text-anchor": anchor }, words);

function extent(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  const spread = high - low || Math.abs(high) || 1;
  return [low - 0.05 * spread, high + 0.05 * spread];
}

function ticksOf(low, high) {
  const raw = (high - low) / 5, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= raw);
  const ticks = [];
  for (let tick = Math.ceil(low / step) * step; tick <= high + 1e-12 * step; tick += step) ticks.push(Math.abs(tick) < step / 1e6 ? 0 : tick);
  return ticks;
}

/* A map of shares from 0 to 1 over two axes, each value at its place along the axis, with a mark where a setting lies.
   rows, columns: values of the axes; cells: rows of shares, null: not known yet; mark: {row, column} as fractions of a cell. */
export function mapPlot(rows, columns, cells, mark, { xLabel, yLabel, about }) {
  const W = 400, H = 300, left = 58, right = 12, top = 10, bottom = 44;
  const wide = (W - left - right) / columns.length, high = (H - top - bottom) / rows.length;
  const x = (k) => left + k * wide, y = (k) => H - bottom - (k + 1) * high;
  const node = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": about });
  cells.forEach((row, i) => row.forEach((share, k) => {
    const fill = share === null ? "none" : "var(--blue)";
    node.append(svg("rect", { x: x(k), y: y(i), width: wide, height: high, fill, "fill-opacity": 0.08 + 0.72 * (share ?? 0), stroke: "var(--line)" }));
  }));
  columns.forEach((value, k) => k % 2 || node.append(text(brief(value), x(k + 0.5), H - bottom + 15, "middle")));
  rows.forEach((value, i) => i % 2 || node.append(text(brief(value), left - 6, y(i) + high / 2 + 4, "end")));
  const at = [x(Math.min(columns.length, Math.max(0, mark.column + 0.5))), y(Math.min(rows.length, Math.max(0, mark.row + 0.5)) - 1)];
  node.append(svg("circle", { cx: at[0], cy: at[1], r: 7, fill: "none", stroke: "var(--page)", "stroke-width": 5 }));
  node.append(svg("circle", { cx: at[0], cy: at[1], r: 7, fill: "none", stroke: "var(--red)", "stroke-width": 2.5 }));
  node.append(text(xLabel, (left + W - right) / 2, H - 8, "middle"));
  const side = text(yLabel, 0, 0, "middle");
  side.setAttribute("transform", `translate(13 ${(top + H - bottom) / 2}) rotate(-90)`);
  node.append(side);
  return node;
}

export function legend(...entries) {
  return element("ul", { class: "legend" }, entries.map(([kind, words]) =>
    element("li", { class: kind.split(" ")[0] }, element("i", { class: kind.split(" ")[1] ?? "" }), element("span", {}, words))));
}
