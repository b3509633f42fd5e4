// Inputs and outputs of several experiments in the same plots, with safety levels.

import { el } from "./api.js";
import { COLOURS } from "./curves.js";
import { Plot, range, shown } from "./plot.js";

/** Both safety levels of an output, as bands with a name, in its shown unit. */
export function levelsOf({ warning_level: warning, critical_level: critical, factor, shown_unit: unit }) {
  const found = [["warning", warning, critical], ["critical", critical, null]].filter(([, level]) => level !== null);
  return found.flatMap(([word, level, next]) => [1, -1].map((sign) => ({
    y: sign * level * factor, until: next === null ? undefined : sign * next * factor, color: word, word: sign > 0 ? `${word} level ${shown(level * factor)} ${unit}` : "",
  })));
}

/** The first time at which an output passed its critical level, or else its warning level. */
export function passed({ warning_level: warning, critical_level: critical, factor }, time, values, who = "") {
  for (const [word, level] of [["critical", critical], ["warning", warning]]) {
    const k = level === null ? -1 : values.findIndex((value) => Math.abs(value) >= level * factor);
    if (k >= 0) return [{ x: time[k], color: word, word: `${who}${word} level passed at ${shown(time[k])} s` }];
  }
  return [];
}

export function reach(part, values) {
  const always = levelsOf(part).map(({ y }) => 1.1 * y), usual = 0.1 * part.scale * part.factor;
  return range(values, ...(always.length ? always : [-usual, usual]));
}

/** A plot of every input and output; `all` says of which experiments, `kind` which outputs. */
export function signalPlots(parent, plant, all, kind = "") {
  const title = (part) => el("span", {}, part.name, " ", el("span", { class: "unit" }, part.shown_unit));
  return [
    ...plant.inputs.map((part) => new Plot(parent, title(part), `${part.name} ${all}`)),
    ...plant.outputs.map((part) => new Plot(parent, title(part), `${kind}${part.name} ${all}`)),
  ];
}

/** One line an experiment {name, time, inputs, outputs}, with what `pick` takes of it. */
export const linesOf = (compared, more, pick) => compared.map((own, i) => ({ x: own.time, name: own.name, color: COLOURS[i % COLOURS.length], ...more, y: pick(own) }));

/** Draws the signals of experiments in the plots that were made for them. */
export function drawSignals(plots, plant, compared) {
  const x = [0, Math.max(...compared.map(({ time }) => time.at(-1)))], unit = "s";
  plant.inputs.forEach((part, i) => {
    const found = linesOf(compared, { step: true, width: 1.2 }, (own) => own.time.map((_, k) => own.inputs[k]?.[i] ?? null));
    plots[i].show({ x, unit, y: range(found.flatMap(({ y }) => y), -part.amplitude, part.amplitude), lines: found });
  });
  plant.outputs.forEach((part, i) => {
    const found = linesOf(compared, {}, (own) => own.outputs.map((row) => (row[i] === null ? null : row[i] * part.factor))), plot = plots[plant.inputs.length + i];
    const marks = found.flatMap(({ name, y }, k) => passed(part, compared[k].time, y, `${name}: `).filter(({ color }) => color === "critical"));
    plot.show({ x, unit, y: reach(part, found.flatMap(({ y }) => y)), levels: levelsOf(part), marks: marks.map((mark) => ({ ...mark, word: "" })), lines: found });
    plot.note.textContent = marks.map(({ word }) => word).join("; ");
  });
}
