// Trainings of this browser: start, watch, stop.

import { el, get, options, post, remove, say } from "./api.js";
import { curves } from "./curves.js";

const section = document.getElementById("training"), form = section.querySelector("form");
const at = (id) => document.getElementById(id), cards = new Map();
let timer = null;

export function begin(catalogue) {
  options(at("training-plant"), Object.keys(catalogue.plants), "aero2");
  form.querySelector(".primary").disabled = false;
  form.addEventListener("submit", (event) => { event.preventDefault(); start(); });
}

async function start() {
  try {
    const training = await post("api/trainings", {
      plant: at("training-plant").value,
      name: at("training-name").value,
      objective: at("objective").value,
      updates: +at("updates").value,
      steps: +at("training-steps").value,
      spread: +at("spread").value / 100,
    });
    say(form, `Started in ${training.folder}.`);
    open();
  } catch (error) {
    say(form, error.message, true);
  }
}

export async function open() {
  clearTimeout(timer);
  try {
    const { trainings } = await get("api/trainings");
    trainings.forEach(show);
    if (!section.hidden && trainings.some(isRunning)) timer = setTimeout(open, 1000);
  } catch (error) {
    say(form, error.message, true);
  }
}

const isRunning = ({ state }) => ["starting", "training", "stopping"].includes(state);

function show(training) {
  if (!cards.has(training.name)) cards.set(training.name, newCard(training));
  const card = cards.get(training.name), rows = training.curve;
  const running = { starting: "starting; the first evaluation takes about a minute", training: "training", stopped: "stopped; rerun the command to resume from the last checkpoint (one every twenty seconds)" };
  const sentence = training.sentence || running[training.state] || training.state;
  if (card.state.textContent !== sentence) card.state.textContent = sentence;
  card.far.textContent = isRunning(training) && rows.length ? `${rows.at(-1).steps} steps` : "";
  card.state.className = training.state === "failed" ? "bad" : "";
  card.stop.disabled = !isRunning(training);
  if (!rows.length) return;
  const columns = Object.fromEntries(Object.keys(rows[0]).map((name) => [name, rows.map((row) => row[name])]));
  const curve = { agent: training.folder, is_bound: training.is_bound, columns };
  if (card.draw) card.draw([curve]);
  else card.draw = curves(card.plots, [curve]);
}

function newCard(training) {
  const card = { state: el("p", { role: "status" }), far: el("p", { class: "progress" }), plots: el("div", { class: "plots small" }) };
  card.stop = el("button", { type: "button", click: async () => {
    card.stop.disabled = true;
    try { show(await remove(`api/trainings/${training.name}`)); } catch (error) { say(form, error.message, true); }
  } }, "Stop");
  at("trainings").querySelector(":scope > .hint")?.remove();
  at("trainings").prepend(el("section", { class: "card", "aria-label": `Training ${training.folder}` },
    el("h2", {}, training.folder), card.state, card.far, el("p", {}, el("code", {}, training.command)), card.plots, el("p", { class: "row" }, card.stop)));
  return card;
}
