// Information of methods against their violations; it answers to the pointer and to the keyboard.

import { el } from "./api.js";
import { range, shown, ticks } from "./plot.js";

const LEFT = 46, RIGHT = 18, TOP = 10, BOTTOM = 44, LINEAR = 0.1; // below so many percent the axis is linear
const resized = new ResizeObserver((entries) => entries.forEach(({ target }) => target.draw()));

function svg(name, attributes, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

/** A plot of points {method, told, rate, interval, violations, is_best} in `parent`; what is told is a quantity {name, about}. */
export function drawFrontier(parent, every, quantity) {
  const points = every.map((point) => ({ ...point, percent: 100 * point.rate, ends: point.interval.map((end) => 100 * end) }))
    .sort((a, b) => a.percent - b.percent || a.told - b.told);
  const read = el("p", { role: "status" }, "Point at a method, or move from one to the next with the arrow keys.");
  const chart = el("div", {
    class: "frontier", tabindex: "0", role: "group", keydown: press, pointermove: point, pointerdown: point,
    "aria-label": "Information of each method over its share of violations. Arrow keys move from method to method.",
  });
  let active = -1, places = [];
  parent.append(read, chart, el("p", { class: "hint below" }, `Vertical: ${quantity.about}. Bars: 95 % intervals. Filled: no other method tells more with as few violations, or as much with fewer; one that knows the plant does not count.`));

  function mark(i) {
    active = i;
    [...chart.querySelectorAll(".method")].forEach((mark, k) => mark.classList.toggle("active", k === i));
    if (i < 0) return;
    const { method, told, violations, is_best: isBest } = points[i];
    const sentence = `${method}: ${quantity.name} ${shown(told, 4)}, violations ${violations}${isBest ? ", not beaten" : ""}`;
    if (read.textContent !== sentence) read.textContent = sentence;
  }

  function press(event) {
    const steps = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, Home: -Infinity, End: Infinity };
    if (!(event.key in steps) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    mark(Math.max(0, Math.min(points.length - 1, active + steps[event.key])));
  }

  function point(event) {
    const { left, top } = chart.getBoundingClientRect(), x = event.clientX - left, y = event.clientY - top;
    const far = places.map((at) => Math.hypot(at.x - x, at.y - y));
    mark(far.indexOf(Math.min(...far)));
  }

  chart.draw = () => {
    const { clientWidth: width, clientHeight: height } = chart, right = width - RIGHT, bottom = height - BOTTOM;
    if (!chart.isConnected) resized.unobserve(chart);
    if (!width) return;
    const decades = Math.log10(100 / LINEAR), [low, high] = range(points.map(({ told }) => told));
    const X = (percent) => LEFT + 12 + ((percent < LINEAR ? percent / LINEAR : 1 + Math.log10(percent / LINEAR)) / (1 + decades)) * (right - LEFT - 12);
    const Y = (told) => bottom - ((told - low) / (high - low)) * (bottom - TOP);
    const line = (x1, y1, x2, y2, name) => svg("line", { x1, y1, x2, y2, class: name });
    const text = (x, y, anchor, word) => svg("text", { x, y, "text-anchor": anchor }, word);
    const grid = [
      ...[0, 0.1, 1, 10, 100].flatMap((x) => [line(X(x), TOP, X(x), bottom, "grid"), text(X(x), bottom + 18, "middle", String(x))]),
      ...ticks(low, high, 5).flatMap((y) => [line(LEFT, Y(y), right, Y(y), "grid"), text(LEFT - 6, Y(y) + 4, "end", String(+y.toPrecision(4)))]),
      text((LEFT + right) / 2, height - 6, "middle", "violations, % of experiments"),
    ];
    places = points.map((own) => ({ x: X(own.percent), y: Y(own.told) }));
    const best = places.filter((_, i) => points[i].is_best), stairs = best.flatMap(({ x, y }, i) => [`${x},${i ? best[i - 1].y : bottom}`, `${x},${y}`]);
    const methods = points.map((own, i) => {
      const { x, y } = places[i], isLate = x > (LEFT + right) / 2;
      const name = text(x + (isLate ? -10 : 10), y - 8, isLate ? "end" : "start", own.method);
      return svg("g", { class: `method${own.is_best ? " best" : ""}` }, line(X(own.ends[0]), y, X(own.ends[1]), y, "bar"), svg("circle", { cx: x, cy: y, r: 5 }), name);
    });
    const end = best.at(-1), edge = end ? [`${right},${end.y}`] : [];
    chart.replaceChildren(svg("svg", { "aria-hidden": "true", width, height }, ...grid, svg("polyline", { class: "stairs", points: [...stairs, ...edge].join(" ") }), ...methods));
    mark(active);
  };
  resized.observe(chart);
}
