// Several runs beside each other: tables of what they found, and their signals in the same plots.

import { el, get, say } from "./api.js";
import { drawSignals, signalPlots } from "./overlay.js";
import { clear, put, rows } from "./run.js";

const section = document.getElementById("runs");

/** Compares runs; they are shown below the table. */
export async function compare(names) {
  const key = `comparison of ${names.join(", ")}`;
  clear(key);
  say(section, "");
  try {
    const { tables, notes, experiments } = await get(`api/runs/compared?${names.map((name) => `name=${encodeURIComponent(name)}`).join("&")}`);
    const card = el("section", { class: "card" }, el("h2", {}, `Comparison: ${names.join(", ")}`));
    for (const table of tables) card.append(el("h3", {}, table.title), rows(table, table.title));
    card.append(...notes.map((note) => el("p", { class: "hint below" }, note)));
    const plots = el("div", { class: "plots" }), signals = el("section", { class: "card shared" }, el("h2", {}, "Input and output"), plots);
    if (!put(key, card, ...(experiments ? [signals] : []))) return;
    if (!experiments) return;
    const { plant, runs, total } = experiments;
    drawSignals(signalPlots(plots, plant, "of all runs over time", "measured "), plant, runs);
    if (total > runs.length) plots.before(el("p", { class: "hint below" }, `The first ${runs.length} of ${total} experiments.`));
  } catch (error) {
    if (put(key)) say(section, error.message, true);
  }
}
