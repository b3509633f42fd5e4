// Learning curves: return, errors or bounds of the parameters, violations over the steps of a training.

import { el, symbol } from "./api.js";
import { Plot, range, shown } from "./plot.js";

export const COLOURS = ["output", "input", "simulated", "critical", "warning", "soft"];
const how = { smoothing: 0, isWhole: false }; // of all learning curves, also those that come later

/** An agent rewarded with information shows the bounds of its experiments, not errors. */
const wordOf = (every) => {
  const words = new Set(every.map((curve) => (curve.is_bound ? "bound" : "error")));
  return [...words].sort().reverse().join(" or ");
};

/** The mean of the values up to each, those before count less by a factor. */
function smoothed(values, factor) {
  let sum = 0, weight = 0;
  return values.map((value) => {
    if (value === null) return null;
    sum = factor * sum + value;
    weight = factor * weight + 1;
    return sum / weight;
  });
}

/** The ends of a scale on which few values far from the others do not count; the newest does. */
function robust(values, newest) {
  const sorted = values.filter(Number.isFinite).sort((a, b) => a - b), at = (share) => sorted[Math.round(share * (sorted.length - 1))];
  if (!sorted.length) return [];
  const room = 1.5 * (at(0.9) - at(0.1));
  return [Math.max(sorted[0], Math.min(at(0.1) - room, ...newest)), Math.min(sorted.at(-1), Math.max(at(0.9) + room, ...newest))];
}

/** Draws curves {agent, is_bound, columns}, one thin line a seed, one colour an agent; returns a function that draws anew. */
export function curves(parent, every) {
  const agents = [...new Set(every.map((curve) => curve.agent))];
  const names = Object.keys(every[0]?.columns ?? {}).filter((name) => name.startsWith("relative_error_"));
  const plots = ["return", "violation_rate", ...names].map((name) => {
    const word = name.replace("relative_error_", "");
    const title = name === word ? name.replace("_", " ") : el("span", {}, `${wordOf(every)} of `, symbol(word), " ", el("span", { class: "unit" }, "%"));
    return [name, new Plot(parent, title, `${name === word ? name.replace("_", " ") : `${wordOf(every)} of ${word}`} over the steps of the training`)];
  });
  let now = every;
  const change = (name, of) => ({ input: (event) => { how[name] = of(event.target); draw(now); } });
  parent.before(el("p", { class: "row scales" },
    el("label", {}, "Smoothing ", el("input", { type: "range", min: 0, max: 0.95, step: 0.05, value: how.smoothing, ...change("smoothing", ({ value }) => +value) })),
    el("label", {}, el("input", { type: "checkbox", checked: how.isWhole, ...change("isWhole", ({ checked }) => checked) }), " scales with outliers")));
  function draw(next) {
    now = next;
    const last = Math.max(1, ...now.map(({ columns }) => columns.steps?.at(-1) ?? 1));
    const [part, unit] = last >= 1e6 ? [1e6, "million steps"] : last >= 1e3 ? [1e3, "thousand steps"] : [1, "steps"];
    for (const [name, plot] of plots) {
      const isPercent = name.startsWith("relative_error_");
      const measured = now.map(({ columns }) => (columns[name] ?? []).map((v) => (isPercent && v !== null ? Math.log10(Math.max(100 * v, 1e-9)) : v)));
      const lines = now.map(({ agent, is_bound: isBound, columns }, i) => ({
        name: agents.length > 1 ? `${agent}${isBound ? ", bound" : ""}` : undefined,
        x: (columns.steps ?? []).map((steps) => steps / part), color: COLOURS[agents.indexOf(agent) % COLOURS.length], dots: now.length === 1 && !how.smoothing, width: now.length > 1 ? 1 : 1.6,
        y: smoothed(measured[i], how.smoothing),
      }));
      const behind = how.smoothing ? lines.map(({ x }, i) => ({ x, y: measured[i], color: "line", width: 1 })) : [];
      const values = measured.flat().filter(Number.isFinite), newest = measured.map((own) => own.at(-1)).filter(Number.isFinite);
      const ends = how.isWhole && values.length ? [Math.min(...values), Math.max(...values)] : robust(values, newest);
      const outside = values.filter((v) => v < ends[0] || v > ends[1]).length;
      const base = isPercent ? [Math.floor(ends[0] ?? 0), Math.ceil(ends[1] ?? 1)] : name === "return" ? [] : [0, 0.05];
      plot.show({ x: [0, last / part], unit, y: range(ends, ...base), lines: [...behind, ...lines], log: isPercent });
      const only = now.length === 1 && newest.length ? shown(isPercent ? 10 ** newest[0] : newest[0]) : "";
      plot.note.textContent = [only, outside ? `${outside} outside` : ""].filter(Boolean).join(", ");
    }
  }
  draw(every);
  return draw;
}
