// Trainings of this server: start, watch, stop, resume.

import { el, get, options, post, remove, say, tellInvalid } from "./api.js";
import { curves } from "./curves.js";
import { Kept } from "./kept.js";
import { shown } from "./plot.js";

const section = document.getElementById("training"), form = section.querySelector("form");
const at = (id) => document.getElementById(id), cards = new Map();
let timer = null, resources = null;

export function begin(catalogue) {
  options(at("training-plant"), Object.keys(catalogue.plants), "aero2");
  form.querySelector(".primary").disabled = false;
  form.addEventListener("input", tellResources);
  tellInvalid(form);
  form.addEventListener("submit", (event) => { event.preventDefault(); start(); });
  const gone = new Kept(form, false).fill();
  if (gone) say(form, gone, true);
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
      seeds: +at("training-seeds").value,
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
    const told = await get("api/trainings");
    resources = told.resources;
    tellResources();
    told.trainings.forEach(show);
    if (!section.hidden && told.trainings.some(isRunning)) timer = setTimeout(open, 1000);
  } catch (error) {
    say(form, error.message, true);
  }
}

/** What the training of the form takes, and what there is of it. */
function tellResources() {
  if (!resources) return;
  const { cores, free_bytes: free, running, most, num_plants: plants } = resources, seeds = +at("training-seeds").value;
  const count = Math.min(cores, seeds), samples = +at("updates").value * plants * +at("training-steps").value * seeds;
  const memory = free === null ? "" : `, ${shown(free / 2 ** 30)} GiB of memory free`;
  at("resources").textContent = `Takes ${count} of ${cores} core${cores > 1 ? "s" : ""}${memory}; ${running} of at most ${most} trainings running. `
    + `It simulates ${plants} plants an update, ${shown(samples / 1e6)} million samples in all.`;
}

const isRunning = ({ state }) => ["starting", "training", "stopping"].includes(state);

function show(training) {
  if (!cards.has(training.name)) cards.set(training.name, newCard(training));
  const card = cards.get(training.name), seeds = Object.entries(training.curves);
  const sentence = training.sentence || (training.state === "stopped" ? "stopped; it can be resumed from the last checkpoint (one every twenty seconds)" : training.state);
  if (card.state.textContent !== sentence) card.state.textContent = sentence;
  card.far.textContent = training.progress;
  card.state.className = training.state === "failed" ? "bad" : "";
  card.stop.disabled = !isRunning(training);
  card.resume.hidden = training.state !== "stopped";
  if (!seeds.length) return;
  const every = seeds.map(([, rows]) => ({
    agent: training.folder, is_bound: training.is_bound,
    columns: Object.fromEntries(Object.keys(rows[0]).map((name) => [name, rows.map((row) => row[name])])),
  }));
  if (card.draw) card.draw(every);
  else card.draw = curves(card.plots, every);
}

function newCard(training) {
  const card = { state: el("p", { role: "status" }), far: el("p", { class: "progress" }), plots: el("div", { class: "plots small" }) };
  const button = (text, ask) => el("button", { type: "button", click: async (event) => {
    event.target.disabled = true;
    try { show(await ask(`api/trainings/${training.name}`)); open(); } catch (error) { say(form, error.message, true); }
    event.target.disabled = false;
  } }, text);
  card.stop = button("Stop", remove);
  card.resume = button("Resume", (address) => post(address, {}));
  at("trainings").querySelector(":scope > .hint")?.remove();
  at("trainings").prepend(el("section", { class: "card", "aria-label": `Training ${training.folder}` },
    el("h2", {}, training.folder), card.state, card.far, el("p", {}, el("code", {}, training.command)), card.plots, el("p", { class: "row" }, card.stop, card.resume)));
  return card;
}
