// Learning curves: return, relative errors, violations over the steps of a training.

import { el, symbol } from "./api.js";
import { Plot, range, shown } from "./plot.js";

const COLOURS = ["output", "input", "simulated", "warning", "critical", "soft"];

/** Draws curves, each an object of columns, one line a seed; returns a function that draws anew. */
export function curves(parent, every) {
  const names = Object.keys(every[0] ?? {}).filter((name) => name.startsWith("relative_error_"));
  const plots = ["return", "violation_rate", ...names].map((name) => {
    const word = name.replace("relative_error_", "");
    const title = name === word ? name.replace("_", " ") : el("span", {}, "error of ", symbol(word), " %");
    return [name, new Plot(parent, title, `${name.replaceAll("_", " ")} over the steps of the training`)];
  });
  const draw = (now) => {
    const last = Math.max(1, ...now.map((c) => c.steps?.at(-1) ?? 1));
    for (const [name, plot] of plots) {
      const isError = name.startsWith("relative_error_");
      const lines = now.map((c, i) => ({
        x: c.steps ?? [], color: COLOURS[i % COLOURS.length], dots: now.length === 1, width: now.length > 1 ? 1 : 1.6,
        y: (c[name] ?? []).map((v) => (isError ? Math.log10(Math.max(100 * v, 1e-9)) : v)),
      }));
      const values = lines.flatMap((line) => line.y);
      const base = isError ? [Math.floor(Math.min(...values, 9)), Math.ceil(Math.max(...values, -9))] : name === "return" ? [values[0] ?? 0] : [0, 0.05];
      plot.show({ x: [0, last], y: range(values, ...base), lines, log: isError });
      const newest = now.length === 1 ? now[0][name]?.at(-1) : null;
      plot.note.textContent = newest === null || newest === undefined ? "" : shown(isError ? 100 * newest : newest);
    }
  };
  draw(every);
  return draw;
}
