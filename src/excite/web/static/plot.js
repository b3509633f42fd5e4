// Plots over time: a shared cross-hair, zoom and files; uPlot draws the lines (uplot/LICENSE).

import { el, keep } from "./api.js";

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

const plots = new Set();
/** The plots on the page; those that were taken away are given up. */
function alive() {
  for (const plot of plots) if (!plot.chart.isConnected) plot.end();
  return [...plots];
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => alive().forEach((plot) => plot.draw(true)));
const resized = new ResizeObserver((entries) => entries.forEach((entry) => entry.target.plot.resize()));

/** Round numbers that divide a range into about so many parts. */
export function ticks(low, high, about) {
  const raw = (high - low) / about, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((f) => f * power).find((s) => s >= raw * 0.7);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) found.push(i * step);
  return found;
}

/** A number with so many significant digits, as people read it. */
export function shown(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e-3 || size >= 1e5) return value.toExponential(digits - 1).replace("e+", "e");
  return value.toFixed(Math.max(0, digits - 1 - Math.floor(Math.log10(size))));
}

/** So many digits that the uncertainty of a value has two of its own. */
export function digits(value, uncertainty) {
  const count = Math.ceil(Math.log10(Math.abs(value / uncertainty))) + 2;
  return Number.isFinite(count) ? Math.min(12, Math.max(3, count)) : 5;
}

/** Labels of ticks, with so many digits that they differ. */
function labels(found) {
  const size = Math.max(...found.map(Math.abs)), digits = Math.ceil(Math.log10(size / (found[1] - found[0]))) + 2;
  return found.map((value) => String(+value.toPrecision(Math.min(15, Math.max(6, digits || 6)))).replace("-", "−"));
}
/** Those of an axis whose last one has the unit. */
const withUnit = (found, unit) => labels(found).map((word, i) => word + (i === found.length - 1 && unit ? ` ${unit}` : ""));
const isNumber = (value) => value !== null && value !== undefined && Number.isFinite(value);

/** A range with a little room, that always holds some numbers. */
export function range(values, ...always) {
  let low = Math.min(...always), high = Math.max(...always);
  for (const value of values) {
    if (!isNumber(value)) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (low > high) low = high = 0; // there is no number
  if (low === high) { low -= 1; high += 1; }
  const room = 0.06 * (high - low);
  return [low - room, high + room];
}

/** Index of the number in an ascending list that is nearest to x. */
function nearest(list, x) {
  let low = 0, high = list.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (list[middle] < x) low = middle; else high = middle;
  }
  return Math.abs(list[low] - x) <= Math.abs(list[high] - x) ? low : high;
}

const DOT = 3.5; // diameter of a measured sample [px]

/** Where a plot draws samples, from first to last: their coordinates on the canvas. */
function placed(u, series) {
  const x = u.data[0], y = u.data[series], { left, top, width, height } = u.bbox, { x: { min: x0, max: x1 }, y: { min: y0, max: y1 } } = u.scales;
  const perX = width / (x1 - x0), perY = height / (y1 - y0);
  return { y, X: (i) => left + (x[i] - x0) * perX, Y: (value) => top + (y1 - value) * perY };
}

/** Samples as points. */
function scattered(u, series, first, last) {
  const { y, X, Y } = placed(u, series), radius = (DOT / 2) * devicePixelRatio, path = new Path2D();
  for (let i = first; i <= last; i++) {
    if (!isNumber(y[i])) continue;
    const at = X(i), height = Y(y[i]);
    path.moveTo(at + radius, height);
    path.arc(at, height, radius, 0, 2 * Math.PI);
  }
  return { stroke: null, fill: path, flags: 1 };
}

/** Fills what many samples a pixel cover: from the lowest to the highest of each column of pixels, and of a line also from the sample before. */
function cover(u, series, first, last, size, isLine) {
  const { y, X, Y } = placed(u, series), half = (size / 2) * devicePixelRatio, { ctx: g, bbox: box } = u;
  let column = -Infinity, low = Infinity, high = -Infinity, before = null;
  const end = () => { if (low <= high) g.fillRect(column, Y(high) - half, 1, Y(low) - Y(high) + 2 * half); }; // far quicker than one path of all
  g.save();
  g.beginPath();
  g.rect(box.left, box.top, box.width, box.height);
  g.clip();
  g.fillStyle = u.series[series].fill(u, series);
  for (let i = first; i <= last; i++) {
    const value = y[i];
    if (isNumber(value)) {
      const at = Math.floor(X(i));
      if (at !== column) {
        end();
        column = at;
        low = high = isLine && before !== null ? before : value;
      }
      if (value < low) low = value;
      if (value > high) high = value;
      before = value;
    } else if (value === null) before = null; // a gap
  }
  end();
  g.restore();
  return null; // no path: it is filled again with the next drawing
}

const joined = uPlot.paths.linear(), held = uPlot.paths.stepped({ align: 1 });
/** How a line is drawn: its samples, or what they cover where there are several a pixel. */
const pathsOf = ({ points, step, width }) => (u, series, first, last) => {
  if (last - first > 4 * u.bbox.width) return cover(u, series, first, last, points ? DOT : width ?? 1.6, !points);
  return points ? scattered(u, series, first, last) : { ...(step ? held : joined)(u, series, first, last), fill: null };
};

/** Of the samples [x, y] in a column of pixels the first, lowest, highest and last; of points one a pixel, too. */
function thinned(samples, arePoints) {
  const columns = new Map();
  for (const sample of samples) {
    const column = Math.round(sample[0]);
    if (columns.has(column)) columns.get(column).push(sample);
    else columns.set(column, [sample]);
  }
  return [...columns.values()].flatMap((column) => {
    if (column.length <= 4) return column;
    const rising = [...column].sort(([, a], [, b]) => a - b), enough = new Set([column[0], rising[0], rising.at(-1), column.at(-1)]);
    if (arePoints) new Map(rising.map((sample) => [Math.round(sample[1]), sample])).forEach((sample) => enough.add(sample));
    return column.filter((sample) => enough.has(sample));
  });
}

/** What the plots of one view share: the cross-hair, and the part of the axis that is shown. */
class Group {
  constructor() {
    this.sync = uPlot.sync(`view ${Math.random()}`);
    this.zoom = null;
  }

  get plots() { return alive().filter((plot) => plot.group === this); }

  /** Shows a part of the axis; null for all of it. */
  show(zoom) {
    this.zoom = zoom;
    this.plots.forEach((plot) => plot.rescale());
  }

  /** Puts the cross-hair of all plots at x. */
  point(x) {
    for (const { u } of this.plots) u?.setCursor({ left: u.valToPos(x, "x"), top: 0 });
  }
}

/** The part of the page around a place, whose plots share cross-hair and zoom. */
const viewOf = (place) => place.closest(".own, .shared") ?? place;

/** Takes away the plots in some places; their views show all of the axis again. */
export function empty(...places) {
  for (const place of places) {
    place.replaceChildren();
    viewOf(place).group?.show(null);
  }
}

export class Plot {
  /** A figure in `parent`; `about` says in words what is drawn. Plots of a view share cross-hair and zoom. */
  constructor(parent, title, about) {
    const view = viewOf(parent);
    this.group = (view.group ??= new Group());
    this.note = el("span");
    this.read = el("span", { class: "read" });
    this.legend = el("span", { class: "legend" });
    this.chart = el("div", {
      class: "chart", tabindex: "0", role: "group", keydown: (event) => this.press(event),
      "aria-label": `${about}. Arrow keys move the cross-hair, plus and minus zoom, zero shows all.`,
    });
    this.chart.plot = this;
    const file = (kind, make) => el("button", { type: "button", "aria-label": `${about}: save as ${kind}`, click: make }, kind);
    this.files = el("span", { class: "files" }, file("PNG", () => this.png()), file("SVG", () => this.svg()), file("CSV", () => this.csv()));
    this.name = el("b", {}, title);
    parent.append(el("figure", {}, el("figcaption", {}, this.name, this.read, this.note, this.files), this.legend, this.chart));
    Object.assign(this, { what: null, u: null, made: "", hidden: new Set() });
    alive();
    plots.add(this);
    resized.observe(this.chart);
  }

  /**
   * Draws on the next frame: {x: [low, high], y: [low, high], unit, log, lines, bands, levels, marks}.
   * A line is {x, y, name, color, dash, step, dots, points, width}; those with a name can be hidden.
   */
  show(what) {
    if (!this.waiting) requestAnimationFrame(() => { this.waiting = false; this.draw(); });
    this.waiting = true;
    this.what = what;
  }

  get lines() { return this.what.lines.filter((line) => !this.hidden.has(line.name)); }

  /** To the right of the axis [px]: for half of its last label, which has the unit. */
  get room() {
    const [low, high] = this.group.zoom ?? this.what.x, found = ticks(low, high, Math.max(2, this.chart.clientWidth / 90));
    const half = 3.5 * (withUnit(found, this.what.unit).at(-1) ?? "").length + 4;
    const rest = ((high - (found.at(-1) ?? high)) / (high - low)) * (this.chart.clientWidth - 54 - half);
    return Math.max(18, half - rest);
  }

  get size() { return { width: this.chart.clientWidth, height: this.chart.clientHeight }; }

  end() {
    this.u?.destroy();
    resized.unobserve(this.chart);
    plots.delete(this);
  }

  resize() {
    this.u?.setSize(this.size);
    this.draw();
  }

  /** Draws what is to be shown; where the plot is hidden, as soon as it is not. */
  draw(isNew = false) {
    if (isNew) this.made = "";
    if (!this.what || !this.chart.clientWidth) return;
    const kind = JSON.stringify([this.what.unit, this.what.log, this.lines.map(({ x, y, ...how }) => how)]);
    if (this.u && kind === this.made) this.u.setData(this.data());
    else {
      this.u?.destroy();
      this.made = kind;
      this.u = new uPlot(this.options(), this.data(), this.chart);
      this.toggles();
    }
  }

  /** Columns for uPlot: the times of all lines together, and a value or a gap of each line there. */
  data() {
    const clean = (y) => y.map((value) => (isNumber(value) ? value : null));
    const { lines } = this;
    if (!lines.length) return [[]];
    const isShared = lines.every(({ x }) => x === lines[0].x);
    if (isShared) return [lines[0].x, ...lines.map(({ y }) => clean(y))];
    return uPlot.join(lines.map(({ x, y }) => [x, clean(y)]));
  }

  options() {
    const soft = colour("soft"), grid = { stroke: colour("line"), width: 1 };
    const axis = { stroke: soft, grid, ticks: { show: false }, font: "12px system-ui, sans-serif" };
    const { unit, log } = this.what;
    return {
      ...this.size, legend: { show: false }, padding: [8, () => this.room, 0, 0],
      scales: { x: { time: false, range: () => this.group.zoom ?? this.what.x }, y: { range: () => this.reach() } },
      axes: [
        { ...axis, size: 26, splits: (u, i, low, high) => ticks(low, high, Math.max(2, u.bbox.width / devicePixelRatio / 90)), values: (u, found) => withUnit(found, unit) },
        { ...axis, size: (u, found) => Math.max(54, ...(found ?? []).map((word) => 6.8 * (word ?? "").length + 8)), gap: 4, splits: (u, i, low, high) => ticks(low, high, 4).filter((y) => !log || Math.abs(y - Math.round(y)) < 1e-6), values: (u, found) => (log ? found.map((y) => shown(10 ** y, 1)) : labels(found)) },
      ],
      cursor: {
        sync: { key: this.group.sync.key, scales: ["x", null] }, y: false,
        drag: { x: true, y: false, setScale: false, dist: 5 },
        bind: { dblclick: () => () => this.group.show(null) },
      },
      series: [{}, ...this.lines.map((line) => ({
        stroke: colour(line.color), width: line.width ?? 1.6, dash: line.dash,
        fill: colour(line.color), paths: pathsOf(line),
        points: { show: Boolean(line.dots), size: 5, fill: colour(line.color), width: 0 },
      }))],
      hooks: {
        drawAxes: [(u) => this.below(u)], draw: [(u) => this.above(u)],
        setCursor: [(u) => this.tell(u)], setSelect: [(u) => this.select(u)],
      },
    };
  }

  /** The range of y: as asked, or that of the part of the axis that is shown. */
  reach() {
    const { zoom } = this.group, { log, y } = this.what;
    if (!zoom || log) return y;
    let low = Infinity, high = -Infinity;
    for (const line of this.lines) {
      for (let i = nearest(line.x, zoom[0]), last = nearest(line.x, zoom[1]); i <= last; i++) {
        const value = line.y[i];
        if (line.x[i] < zoom[0] || line.x[i] > zoom[1] || !isNumber(value)) continue;
        if (value < low) low = value;
        if (value > high) high = value;
      }
    }
    return low <= high ? range([low, high], low) : y;
  }

  rescale() {
    this.u?.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.u?.setData(this.u.data);
  }

  select(u) {
    const { left, width } = u.select;
    if (width > 4 && u.cursor.event) this.group.show([u.posToVal(left, "x"), u.posToVal(left + width, "x")]);
  }

  press(event) {
    const { u, what } = this, keys = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity, "+": 0.5, "=": 0.5, "-": 2, 0: null, Escape: null };
    if (!u || !(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    const change = keys[event.key], times = u.data[0], [low, high] = this.group.zoom ?? what.x;
    const first = nearest(times, low), last = nearest(times, high);
    const now = u.cursor.idx ?? first;
    if (event.key.startsWith("Arrow") || event.key === "Home" || event.key === "End") {
      const step = change * (event.shiftKey ? 10 : 1);
      this.group.point(times[Math.min(last, Math.max(first, now + step))]);
    } else if (change === null) this.group.show(null);
    else {
      const middle = times[now] ?? (low + high) / 2, part = change * (high - low);
      const begin = Math.max(what.x[0], Math.min(middle - part / 2, what.x[1] - part));
      this.group.show(part >= what.x[1] - what.x[0] ? null : [begin, begin + part]);
      this.group.point(middle);
    }
  }

  /** Says the values under the cross-hair. */
  tell(u) {
    const x = u.cursor.idx === null || u.cursor.left < 0 ? null : u.data[0][u.cursor.idx], { unit, log } = this.what;
    const at = (line) => {
      const i = nearest(line.x, x), value = line.x.length && Math.abs(line.x[i] - x) < 0.02 * (this.what.x[1] - this.what.x[0]) ? line.y[i] : null;
      return shown(log && isNumber(value) ? 10 ** value : value, 4);
    };
    const isAlone = this.lines.length === 1 && !this.lines[0].name;
    this.read.textContent = x === null || x === undefined ? "" : `${labels([x, x + (this.what.x[1] - this.what.x[0]) / 1000])[0]} ${unit ?? ""}${isAlone ? `: ${at(this.lines[0])}` : ""}`;
    for (const button of this.legend.children) {
      const line = this.lines.find(({ name }) => name === button.dataset.name);
      button.lastChild.textContent = line && x !== null && x !== undefined ? ` ${at(line)}` : "";
    }
  }

  /** One button a named line: it hides the line, and shows its value under the cross-hair. */
  toggles() {
    const named = [...new Map(this.what.lines.filter(({ name }) => name).map((line) => [line.name, line])).values()];
    const focused = this.legend.contains(document.activeElement) ? document.activeElement.dataset.name : null;
    this.legend.replaceChildren(...named.map(({ name, color, points, dash }) => el("button", {
      type: "button", class: `key ${color}${points ? " points" : ""}${dash ? " dashed" : ""}`, "data-name": name, "aria-pressed": String(!this.hidden.has(name)),
      click: () => { if (!this.hidden.delete(name)) this.hidden.add(name); this.draw(true); },
    }, name, el("span"))));
    if (focused !== null) [...this.legend.children].find((button) => button.dataset.name === focused)?.focus();
  }

  /** What lies below the lines: bands, and safety levels with their names. */
  below(u) {
    const { bands = [], levels = [] } = this.what, { ctx: g, bbox: box } = u, ratio = devicePixelRatio;
    const X = (x) => u.valToPos(x, "x", true), Y = (y) => u.valToPos(y, "y", true);
    g.save();
    g.beginPath();
    g.rect(box.left, box.top, box.width, box.height);
    g.clip();
    for (const { x, lower, upper, color } of bands) {
      g.fillStyle = colour(color);
      g.beginPath();
      x.forEach((value, i) => g.lineTo(X(value), Y(lower[i])));
      for (let i = x.length - 1; i >= 0; i--) g.lineTo(X(x[i]), Y(upper[i]));
      g.fill();
    }
    g.font = `${12 * ratio}px system-ui, sans-serif`;
    g.textAlign = "right";
    for (const { y, until, color, word } of levels) {
      g.strokeStyle = g.fillStyle = colour(color);
      const end = until === undefined ? (y > 0 ? box.top : box.top + box.height) : Y(until);
      g.globalAlpha = 0.1;
      g.fillRect(box.left, Math.min(Y(y), end), box.width, Math.abs(end - Y(y)));
      g.globalAlpha = 1;
      g.lineWidth = ratio;
      g.setLineDash([6 * ratio, 4 * ratio]);
      g.beginPath();
      g.moveTo(box.left, Y(y));
      g.lineTo(box.left + box.width, Y(y));
      g.stroke();
      g.textBaseline = y > 0 ? "bottom" : "top";
      if (word && Math.abs(end - Y(y)) > 14 * ratio) g.fillText(word, box.left + box.width - 4 * ratio, Y(y) + (y > 0 ? -2 : 2) * ratio);
    }
    g.restore();
  }

  /** What lies above the lines: marked times. */
  above(u) {
    const { ctx: g, bbox: box } = u, ratio = devicePixelRatio;
    g.save();
    g.font = `${12 * ratio}px system-ui, sans-serif`;
    for (const { x, color, word } of this.what.marks ?? []) {
      const at = u.valToPos(x, "x", true);
      if (at < box.left || at > box.left + box.width) continue;
      g.strokeStyle = g.fillStyle = colour(color);
      g.lineWidth = 1.5 * ratio;
      g.beginPath();
      g.moveTo(at, box.top);
      g.lineTo(at, box.top + box.height);
      g.stroke();
      g.textBaseline = "bottom";
      g.textAlign = at > box.left + box.width / 2 ? "right" : "left";
      g.fillText(word, at + (g.textAlign === "left" ? 4 : -4) * ratio, box.top + box.height - 3 * ratio);
    }
    g.restore();
  }

  get file() { return this.name.textContent.trim().replace(/[^\p{L}\p{N}]+/gu, "_").replace(/^_+|_+$/g, ""); }

  png() {
    const source = this.u.ctx.canvas, canvas = el("canvas", { width: source.width, height: source.height }), g = canvas.getContext("2d");
    g.fillStyle = colour("card");
    g.fillRect(0, 0, canvas.width, canvas.height);
    g.drawImage(source, 0, 0);
    canvas.toBlob((blob) => keep(`${this.file}.png`, blob));
  }

  /** The numbers of the lines in the part that is shown; a name that comes again has its number. */
  csv() {
    const title = this.name.cloneNode(true), own = title.querySelector(".unit"), { unit, log } = this.what, { min, max } = this.u.scales.x;
    own?.remove();
    const names = this.lines.map(({ name }) => name ?? title.textContent.trim());
    const unique = names.map((name, i) => [name, names.slice(0, i).filter((other) => other === name).length + 1]);
    const heads = unique.map(([name, count]) => name + (count > 1 ? ` (${count})` : "") + (own ? ` [${own.textContent}]` : ""));
    const quoted = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
    const value = (y) => (isNumber(y) ? (log ? 10 ** y : y) : "");
    const [times, ...columns] = this.u.data;
    const rows = times.flatMap((x, k) => (x < min || x > max ? [] : [[x, ...columns.map((y) => value(y[k]))].join(",")]));
    const head = [unit === "s" ? "time [s]" : unit ?? "x", ...heads].map(quoted).join(",");
    keep(`${this.file}.csv`, new Blob([[head, ...rows, ""].join("\n")], { type: "text/csv" }));
  }

  /** What is drawn on the canvas, in the same order. */
  svg() {
    const { width, height } = this.size, { x: { min: x0, max: x1 }, y: { min: y0, max: y1 } } = this.u.scales;
    const left = this.u.bbox.left / devicePixelRatio, right = width - this.room, top = 8, bottom = height - 26, two = (v) => +v.toFixed(2);
    const X = (x) => two(left + ((x - x0) / (x1 - x0)) * (right - left)), Y = (y) => two(bottom - ((y - y0) / (y1 - y0)) * (bottom - top));
    const text = (x, y, anchor, word, color = "soft") => `<text x="${x}" y="${y}" text-anchor="${anchor}" fill="${colour(color)}">${word.replaceAll("&", "&amp;").replaceAll("<", "&lt;")}</text>`;
    const line = (points, color, more = "") => `<polyline points="${points.join(" ")}" fill="none" stroke="${colour(color)}" ${more}/>`;
    const { log, unit, levels = [], bands = [], marks = [] } = this.what, times = ticks(x0, x1, Math.max(2, (right - left) / 90));
    const under = withUnit(times, unit), heights = ticks(y0, y1, 4).filter((y) => !log || Math.abs(y - Math.round(y)) < 1e-6), beside = labels(heights);
    const grid = [
      ...times.map((x, i) => line([`${X(x)},${top}`, `${X(x)},${bottom}`], "line") + text(X(x), height - 8, "middle", under[i])),
      ...heights.map((y, i) => line([`${left},${Y(y)}`, `${right},${Y(y)}`], "line") + text(left - 6, Y(y) + 4, "end", log ? shown(10 ** y, 1) : beside[i])),
    ];
    const band = ({ x, lower, upper, color }) => `<polygon points="${[...x.map((v, i) => `${X(v)},${Y(lower[i])}`), ...x.map((v, i) => `${X(v)},${Y(upper[i])}`).reverse()].join(" ")}" fill="${colour(color)}"/>`;
    const level = ({ y, until, color, word }) => {
      const at = Y(y), end = until === undefined ? (y > 0 ? top : bottom) : Y(until);
      return `<rect x="${left}" y="${Math.min(at, end)}" width="${right - left}" height="${two(Math.abs(end - at))}" fill="${colour(color)}" opacity="0.1"/>`
        + line([`${left},${at}`, `${right},${at}`], color, 'stroke-dasharray="6 4"')
        + (word && Math.abs(end - at) > 14 ? text(right - 4, at + (y > 0 ? -3 : 13), "end", word, color) : "");
    };
    const drawn = ({ x, y, color, step, dash, points, dots, width: thick }) => {
      const paths = [[]], samples = []; // a path ends at a gap
      x.forEach((v, i) => {
        if ((x[i + 1] ?? v) < x0 || (x[i - 1] ?? v) > x1) return;
        if (!isNumber(y[i])) { paths.push([]); return; }
        const path = paths.at(-1), at = [X(v), Y(y[i])];
        if (step && path.length) path.push([at[0], path.at(-1)[1]]);
        path.push(at);
        samples.push(at);
      });
      const how = `stroke-width="${thick ?? 1.6}"${dash ? ` stroke-dasharray="${dash.join(" ")}"` : ""}`;
      const spots = () => `<path d="${thinned(samples, true).map(([cx, cy]) => `M${cx} ${cy}h0`).join("")}" fill="none" stroke="${colour(color)}" stroke-width="${points ? DOT : 5}" stroke-linecap="round"/>`;
      return [...(points ? [] : paths.filter((path) => path.length > 1).map((path) => line(thinned(path), color, how))), points || dots ? spots() : ""].join("");
    };
    const mark = ({ x, color, word }) => {
      const at = X(x), [anchor, by] = at > (left + right) / 2 ? ["end", -4] : ["start", 4];
      return at < left || at > right ? "" : line([`${at},${top}`, `${at},${bottom}`], color, 'stroke-width="1.5"') + text(at + by, bottom - 5, anchor, word, color);
    };
    const head = `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${width} ${height}" font-family="system-ui, sans-serif" font-size="12">`;
    const clip = `<clipPath id="c"><rect x="${left}" y="${top}" width="${right - left}" height="${bottom - top}"/></clipPath><rect width="100%" height="100%" fill="${colour("card")}"/>`;
    const inside = ['<g clip-path="url(#c)">', ...bands.map(band), ...levels.map(level), ...this.lines.map(drawn), "</g>"];
    keep(`${this.file}.svg`, new Blob([head, clip, ...grid, ...inside, ...marks.map(mark), "</svg>\n"], { type: "image/svg+xml" }));
  }
}
