// Small plots on a canvas: lines, steps, bands, levels. Colours are those of the page.

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

const plots = new Set();
const redrawAll = () => plots.forEach((plot) => (plot.canvas.isConnected ? plot.draw() : plots.delete(plot)));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redrawAll);
const resized = new ResizeObserver((entries) => entries.forEach((entry) => entry.target.plot?.draw()));

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

const label = (value) => String(+value.toPrecision(6)).replace("-", "−");

export class Plot {
  /** A figure with a caption and a canvas in `parent`; `about` says in words what is drawn. */
  constructor(parent, title, about) {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    this.note = document.createElement("span");
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", about);
    this.canvas.plot = this;
    const name = document.createElement("b");
    name.append(title);
    caption.append(name, this.note);
    figure.append(caption, this.canvas);
    parent.append(figure);
    this.what = null;
    plots.add(this);
    resized.observe(this.canvas);
  }

  /** Draws {x: [low, high], y: [low, high], lines, bands, levels, log} on the next frame. */
  show(what) {
    if (this.what === null || !this.waiting) {
      this.waiting = true;
      requestAnimationFrame(() => { this.waiting = false; this.draw(); });
    }
    this.what = what;
  }

  draw() {
    const { canvas, what } = this, { clientWidth: width, clientHeight: height } = canvas;
    if (!what || !width) return;
    const ratio = devicePixelRatio || 1;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const g = canvas.getContext("2d");
    g.scale(ratio, ratio);
    g.font = "12px system-ui, sans-serif";
    const box = { left: 52, right: width - 10, top: 8, bottom: height - 22 };
    const [x0, x1] = what.x, [y0, y1] = what.y;
    const X = (x) => box.left + ((x - x0) / (x1 - x0 || 1)) * (box.right - box.left);
    const Y = (y) => box.bottom - ((y - y0) / (y1 - y0 || 1)) * (box.bottom - box.top);
    this.grid(g, box, X, Y, what);
    g.save();
    g.beginPath();
    g.rect(box.left, box.top - 2, box.right - box.left, box.bottom - box.top + 4);
    g.clip();
    for (const band of what.bands ?? []) this.band(g, band, X, Y);
    for (const level of what.levels ?? []) this.level(g, level, box, Y);
    for (const line of what.lines ?? []) this.line(g, line, X, Y);
    g.restore();
  }

  grid(g, box, X, Y, what) {
    g.strokeStyle = colour("line");
    g.fillStyle = colour("soft");
    g.lineWidth = 1;
    g.textAlign = "right";
    g.textBaseline = "middle";
    for (const y of ticks(...what.y, 4)) {
      if (what.log && Math.abs(y - Math.round(y)) > 1e-6) continue;
      g.beginPath();
      g.moveTo(box.left, Math.round(Y(y)) + 0.5);
      g.lineTo(box.right, Math.round(Y(y)) + 0.5);
      g.stroke();
      g.fillText(what.log ? shown(10 ** y, 1) : label(y), box.left - 6, Y(y));
    }
    g.textAlign = "center";
    g.textBaseline = "top";
    const marks = ticks(...what.x, Math.max(2, (box.right - box.left) / 90));
    for (const x of marks) {
      const unit = x === marks.at(-1) && what.unit ? ` ${what.unit}` : "";
      const half = g.measureText(label(x) + unit).width / 2;
      g.fillText(label(x) + unit, Math.min(X(x), box.right + 8 - half), box.bottom + 6);
    }
  }

  band(g, { x, lower, upper, color }, X, Y) {
    g.fillStyle = colour(color);
    g.beginPath();
    x.forEach((value, i) => g.lineTo(X(value), Y(lower[i])));
    for (let i = x.length - 1; i >= 0; i--) g.lineTo(X(x[i]), Y(upper[i]));
    g.fill();
  }

  level(g, { y, color, word }, box, Y) {
    g.strokeStyle = g.fillStyle = colour(color);
    g.lineWidth = 1.2;
    g.setLineDash([6, 4]);
    g.beginPath();
    g.moveTo(box.left, Y(y));
    g.lineTo(box.right, Y(y));
    g.stroke();
    g.setLineDash([]);
    if (!word) return;
    g.textAlign = "right";
    g.textBaseline = y > 0 ? "bottom" : "top";
    g.fillText(word, box.right - 2, Y(y) + (y > 0 ? -1 : 2));
  }

  line(g, { x, y, color, dash, step, dots, width }, X, Y) {
    g.strokeStyle = g.fillStyle = colour(color);
    g.lineWidth = width ?? 1.6;
    g.lineJoin = "round";
    g.setLineDash(dash ?? []);
    g.beginPath();
    let before = null;
    x.forEach((value, i) => {
      if (y[i] === null || !Number.isFinite(y[i])) { before = null; return; }
      if (before === null) g.moveTo(X(value), Y(y[i]));
      else {
        if (step) g.lineTo(X(value), Y(before));
        g.lineTo(X(value), Y(y[i]));
      }
      before = y[i];
    });
    g.stroke();
    g.setLineDash([]);
    if (!dots) return;
    x.forEach((value, i) => {
      if (y[i] === null || !Number.isFinite(y[i])) return;
      g.beginPath();
      g.arc(X(value), Y(y[i]), 2.6, 0, 7);
      g.fill();
    });
  }
}

/** A range with a little room, that always holds some numbers. */
export function range(values, ...always) {
  let low = Math.min(...always), high = Math.max(...always);
  for (const value of values) {
    if (value === null || !Number.isFinite(value)) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (!(high > low)) { low -= 1; high += 1; }
  const room = 0.06 * (high - low);
  return [low - room, high + room];
}
