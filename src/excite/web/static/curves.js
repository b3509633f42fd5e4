// Learning curves: return, errors or bounds of the parameters, violations over the steps of a training.

import { el, symbol } from "./api.js";
import { Plot, range, shown } from "./plot.js";

export const COLOURS = ["output", "input", "simulated", "critical", "warning", "soft"];

/** An agent rewarded with information shows the bounds of its experiments, not errors. */
const wordOf = (every) => {
  const words = new Set(every.map((curve) => (curve.is_bound ? "bound" : "error")));
  return [...words].sort().reverse().join(" or ");
};

/** Draws curves {agent, is_bound, columns}, one line a seed, one colour an agent; returns a function that draws anew. */
export function curves(parent, every) {
  const agents = [...new Set(every.map((curve) => curve.agent))];
  const names = Object.keys(every[0]?.columns ?? {}).filter((name) => name.startsWith("relative_error_"));
  const plots = ["return", "violation_rate", ...names].map((name) => {
    const word = name.replace("relative_error_", "");
    const title = name === word ? name.replace("_", " ") : el("span", {}, `${wordOf(every)} of `, symbol(word), " ", el("span", { class: "unit" }, "%"));
    return [name, new Plot(parent, title, `${name === word ? name.replace("_", " ") : `${wordOf(every)} of ${word}`} over the steps of the training`)];
  });
  const draw = (now) => {
    const last = Math.max(1, ...now.map(({ columns }) => columns.steps?.at(-1) ?? 1));
    const [part, unit] = last >= 1e6 ? [1e6, "million steps"] : last >= 1e3 ? [1e3, "thousand steps"] : [1, "steps"];
    for (const [name, plot] of plots) {
      const isPercent = name.startsWith("relative_error_");
      const lines = now.map(({ agent, is_bound: isBound, columns }) => ({
        name: agents.length > 1 ? `${agent}${isBound ? ", bound" : ""}` : undefined,
        x: (columns.steps ?? []).map((steps) => steps / part), color: COLOURS[agents.indexOf(agent) % COLOURS.length], dots: now.length === 1, width: now.length > 1 ? 1 : 1.6,
        y: (columns[name] ?? []).map((v) => (isPercent ? Math.log10(Math.max(100 * v, 1e-9)) : v)),
      }));
      const values = lines.flatMap((line) => line.y);
      const base = isPercent ? [Math.floor(Math.min(...values, 9)), Math.ceil(Math.max(...values, -9))] : name === "return" ? [values[0] ?? 0] : [0, 0.05];
      plot.show({ x: [0, last / part], unit, y: range(values, ...base), lines, log: isPercent });
      const newest = now.length === 1 ? now[0].columns[name]?.at(-1) : null;
      plot.note.textContent = newest === null || newest === undefined ? "" : shown(isPercent ? 100 * newest : newest);
    }
  };
  draw(every);
  return draw;
}
