// Runs beside each other: tables of what they found, and their signals in the same plots.

import { el, get, say } from "./api.js";
import { drawSignals, signalPlots } from "./overlay.js";
import { clear, isWanted, put, rows } from "./view.js";

const section = document.getElementById("runs"), view = document.getElementById("run-view");

const asked = (names) => get(`api/runs/compared?${names.map((name) => `name=${encodeURIComponent(name)}`).join("&")}`);

/** Compares runs; they are shown below the table. */
export async function compare(names) {
  const key = `comparison of ${names.join(", ")}`;
  clear(key);
  say(section, "");
  try {
    const { tables, notes, experiments } = await asked(names);
    if (!isWanted(key)) return;
    const card = el("section", { class: "card" }, el("h2", {}, `Comparison: ${names.join(", ")}`));
    for (const table of tables) card.append(el("h3", {}, table.title), rows(table, table.title));
    card.append(...notes.map((note) => el("p", { class: "hint below" }, note)));
    put(card);
    draw(experiments, "of all runs over time");
  } catch (error) {
    if (isWanted(key)) say(section, error.message, true);
  }
}

/** Adds the signals of a run to what is shown of it. */
export async function signals(name) {
  const { experiments } = await asked([name]);
  if (isWanted(name)) draw(experiments, "over time");
}

function draw(experiments, all) {
  if (!experiments) return;
  const { plant, runs, total } = experiments, plots = el("div", { class: "plots" });
  const left = total > runs.length ? el("p", { class: "hint below" }, `The first ${runs.length} of ${total} experiments.`) : null;
  view.append(el("section", { class: "card shared" }, el("h2", {}, "Input and output"), left, plots));
  drawSignals(signalPlots(plots, plant, all, "measured "), plant, runs);
}
