// Choose a plant and an excitation, run the experiment, watch the estimates.

import { download, el, options, say, symbol, Task, tell } from "./api.js";
import { digits, Plot, range, shown } from "./plot.js";

const section = document.getElementById("experiment"), form = section.querySelector("form");
const at = (id) => document.getElementById(id);
let catalogue, plant, task;

export function begin(known) {
  catalogue = known;
  options(at("plant"), Object.keys(catalogue.plants), "aero2");
  at("plant").addEventListener("change", choosePlant);
  at("excitation").addEventListener("change", chooseExcitation);
  at("steps").addEventListener("input", tellLength);
  at("draw").addEventListener("click", drawParams);
  at("nominal").addEventListener("click", () => fields("params").forEach((f) => { f.value = f.dataset.usual; }));
  form.addEventListener("submit", (event) => { event.preventDefault(); run(); });
  choosePlant();
  task = new Task(form);
  say(form, "Ready.");
}

const fields = (id) => [...at(id).querySelectorAll("input")];

/** A number that is sent only where it was changed: what is not keeps all its digits. */
function numberField(id, name, caption, unit, usual, factor) {
  const value = +(usual * factor).toPrecision(6);
  const input = el("input", { id: `${id}-${name}`, type: "number", step: "any", required: true, value });
  Object.assign(input.dataset, { name, factor, usual: String(value) });
  return el("div", { class: "field" }, el("label", { for: input.id }, caption, " ", el("span", { class: "unit" }, unit)), input);
}

const changed = (id) => Object.fromEntries(fields(id)
  .filter((f) => f.value !== f.dataset.usual)
  .map((f) => [f.dataset.name, +f.value / +f.dataset.factor]));

function choosePlant() {
  plant = catalogue.plants[at("plant").value];
  const policies = Object.keys(plant.policies), names = catalogue.excitations;
  const groups = [
    { label: "signals", group: names.filter((n) => !n.startsWith("loop-")) },
    { label: "signals in a position loop", group: names.filter((n) => n.startsWith("loop-")) },
    { label: "policies", group: policies },
  ].filter((g) => g.group.length);
  options(at("excitation"), groups, "chirp");
  options(at("other1"), groups, "prbs");
  options(at("other2"), groups, policies.includes(plant.name) ? plant.name : "multisine");
  const noisy = plant.outputs.map((o) => numberField("noise", o.name, o.name, o.shown_unit, o.noise_sd, o.factor));
  at("noise").replaceChildren(...noisy);
  fields("noise").forEach((f) => { f.min = 0; });
  at("params").replaceChildren(...plant.parameters.map((p) => numberField("params", p.name, symbol(p.name), p.unit, p.nominal, 1)));
  chooseExcitation();
  tellLength();
}

function chooseExcitation() {
  const name = at("excitation").value, input = plant.inputs[0], isSignal = !name.startsWith("loop-") && !(name in plant.policies);
  const half = (input.upper - input.lower) / 2;
  Object.assign(at("amplitude"), { disabled: !isSignal, max: half, value: input.amplitude });
  section.querySelector("label[for=amplitude] .unit").textContent = isSignal ? `${input.unit}, at most ${half}` : "set by the excitation";
  const policy = plant.policies[name], longest = policy?.num_steps;
  at("claim").textContent = policy ? `Safety: ${policy.claim}.` : "";
  at("steps").max = longest ?? 5000;
  if (longest && +at("steps").value > longest) at("steps").value = longest;
  tellLength();
}

function tellLength() {
  const seconds = +at("steps").value * plant.dt;
  at("seconds").textContent = `${shown(seconds)} s at ${shown(1000 * plant.dt)} ms per sample`;
}

function drawParams() {
  fields("params").forEach((f, i) => {
    const part = plant.parameters[i];
    f.value = +(part.nominal + part.scale * (Math.random() * 0.6 - 0.3)).toPrecision(4);
  });
}

function asked() {
  const pace = at("pace").value;
  return {
    plant: at("plant").value,
    excitation: at("excitation").value,
    amplitude: at("amplitude").disabled ? null : +at("amplitude").value,
    noise: changed("noise"),
    params: changed("params"),
    steps: +at("steps").value,
    seed: +at("seed").value,
    others: [...new Set([at("other1").value, at("other2").value])].filter((n) => n !== at("excitation").value),
    seconds: pace === "real" ? Math.min(60, +at("steps").value * plant.dt) : +pace,
  };
}

const waiting = (live) => (live.found.length ? "Estimating and comparing…"
  : "Compiling the estimator for this plant and length; only needed for the first run…");

function run() {
  const wanted = asked();
  let live = null, rows = [];
  at("outcome").hidden = true;
  for (const plots of ["signals", "estimates"]) at(plots).replaceChildren(); // of the run before
  say(form, "Waiting for a worker…");
  task.run("api/experiments", wanted, (event) => {
    if (event.kind === "started") say(form, "Preparing. The first run with a plant, a length or an excitation compiles programs, which can take a minute or two…");
    else if (event.kind === "plan") live = new Live(event);
    else if (event.kind === "samples") {
      live.samples(event);
      say(form, live.isFull ? waiting(live) : "Running.");
      tell(form, live.isFull ? "" : `${shown(live.time.at(-1))} of ${shown(live.end)} s`);
    } else if (event.kind === "estimate") {
      live.estimate(event);
      if (live.isFull) say(form, waiting(live));
    } else if (["result", "other", "left_out"].includes(event.kind)) {
      rows.push(event.row ?? event);
      compare(live, rows, wanted.others.length + 1);
      if (event.kind === "result") conclude(event);
      if (rows.length === wanted.others.length + 1) say(form, "Done.");
    }
  });
}

/** An experiment under way: what was measured so far, and the estimates. */
class Live {
  constructor(plan) {
    Object.assign(this, { plan, time: [], inputs: [], outputs: [], found: [] });
    this.end = (plan.num_samples - 1) * plan.plant.dt;
    if (matchMedia("(max-width: 60rem)").matches) section.querySelector(".view").scrollIntoView();
    if (plan.warning) say(form, plan.warning, true);
    const title = (part) => el("span", {}, part.name, " ", el("span", { class: "unit" }, part.shown_unit));
    const from = (name) => el("span", {}, symbol(name), " ", el("span", { class: "unit" }, "% from the true value"));
    this.plots = [...plan.plant.inputs, ...plan.plant.outputs].map((part) =>
      new Plot(at("signals"), title(part), `${part.name} over time, with its safety levels`));
    this.tracks = plan.plant.parameters.map((p) =>
      new Plot(at("estimates"), from(p.name), `estimate of ${p.name} over time, deviation from the true value in percent, 95 % interval and Cramér-Rao bound`));
    this.draw();
  }

  get isFull() { return this.time.length === this.plan.num_samples; }

  samples({ time, inputs, outputs }) {
    this.time.push(...time);
    this.inputs.push(...inputs);
    this.outputs.push(...outputs);
    this.draw();
  }

  estimate(event) {
    this.found.push(event);
    const { plant, params } = this.plan, time = this.found.map((e) => (e.k) * plant.dt);
    plant.parameters.forEach(({ name, scale, unit }, i) => {
      const true_ = params[name], per = 100 / (Math.abs(true_) || scale);
      const column = (what) => this.found.map((e) => (e[what][name] === null ? null : e[what][name] * per));
      const middle = column("estimate").map((v) => (v === null ? null : v - true_ * per));
      const half = column("half"), bound = column("bound");
      // The first estimates are far off: the scale follows the later ones.
      const from = Math.floor(this.found.length / 2.5), reach = [];
      for (let j = from; j < middle.length; j++) if (middle[j] !== null) reach.push(Math.abs(middle[j]) + half[j], bound[j]);
      const top = 1.15 * (Math.max(...reach.filter(Number.isFinite), 0) || 100);
      const good = middle.map((v, j) => j).filter((j) => middle[j] !== null);
      const pick = (values) => good.map((j) => values[j]);
      this.tracks[i].show({
        x: [0, this.end], y: [-top, top], unit: "s",
        bands: [{ x: pick(time), lower: good.map((j) => middle[j] - half[j]), upper: good.map((j) => middle[j] + half[j]), color: "band" }],
        lines: [
          { x: time, y: bound, color: "bound", dash: [5, 4], width: 1.2 },
          { x: time, y: bound.map((b) => (b === null ? null : -b)), color: "bound", dash: [5, 4], width: 1.2 },
          { x: time, y: middle, color: "output", dots: true },
        ],
      });
      const last = event.estimate[name];
      this.tracks[i].note.textContent = last === null ? "no estimate yet"
        : `${shown(last, digits(last, event.half[name]))} ± ${shown(event.half[name], 2)} ${unit}`;
    });
  }

  draw() {
    const { inputs, outputs } = this.plan.plant, x = [0, this.end];
    inputs.forEach((part, i) => this.plots[i].show({
      x, y: range(this.inputs.map((row) => row[i]), -part.amplitude, part.amplitude), unit: "s",
      lines: [{ x: this.time.slice(0, this.inputs.length), y: this.inputs.map((row) => row[i]), color: "input", step: true, width: 1.3 }],
    }));
    outputs.forEach((part, i) => {
      const levels = [["warning", part.warning_level], ["critical", part.critical_level]].filter(([, level]) => level !== null)
        .flatMap(([word, level]) => [1, -1].map((sign) => ({ y: sign * level * part.factor, color: word, word: sign > 0 ? `${word} level` : "" })));
      const values = this.outputs.map((row) => row[i] * part.factor);
      const largest = Math.max(...values.map(Math.abs), 0);
      this.plots[inputs.length + i].show({
        x, y: range(values, ...levels.map((l) => 1.1 * l.y), ...(levels.length ? [] : [-0.1 * part.scale * part.factor, 0.1 * part.scale * part.factor])), unit: "s", levels,
        lines: [{ x: this.time, y: values, color: "output" }],
      });
      // A violation is one of the true output, which only the comparison shows.
      this.plots[inputs.length + i].note.textContent = `largest measured ${shown(largest)} ${part.shown_unit}`;
    });
  }
}

function compare(live, rows, total) {
  const { parameters, outputs } = live.plan.plant;
  const found = rows.filter((row) => row.params);
  const best = (name) => Math.min(...found.map((r) => r.params[name].error_percent ?? Infinity));
  const head = ["excitation", "safe", ...outputs.map((o) => `largest true ${o.name} [${o.shown_unit}]`)];
  at("outcome").querySelector("h2").textContent = `Comparison: ${live.plan.plant.name}, ${live.plan.num_samples - 1} samples`;
  at("comparison").replaceChildren(
    el("thead", {}, el("tr", {}, ...head.map((text) => el("th", { scope: "col" }, text)),
      ...parameters.map((p) => el("th", { scope: "col" }, symbol(p.name), " error (bound) %")), el("th", { scope: "col" }, "log det M"))),
    el("tbody", {}, ...rows.map((row) => (row.sentence ? el("tr", {}, el("th", { scope: "row" }, row.excitation),
      el("td", { class: "said", colspan: 2 + outputs.length + parameters.length }, row.sentence)) : el("tr", {},
      el("th", { scope: "row" }, row.excitation),
      el("td", { class: row.is_violation ? "bad" : "good" }, row.is_violation ? "violation" : "yes"),
      ...outputs.map((o) => el("td", {}, shown(row.max_abs_output[o.name] * o.factor))),
      ...parameters.map(({ name }) => {
        const p = row.params[name];
        return el("td", { class: found.length > 1 && p.error_percent === best(name) ? "best" : "" },
          shown(p.error_percent), " ", el("small", {}, `(${shown(p.cramer_rao_percent, 2)})`));
      }),
      el("td", {}, shown(row.log_det_information, 4)))))));
  at("outcome").hidden = false;
  if (rows.length < total) say(form, "Comparing…");
}

function conclude(event) {
  const { identification, row, result } = event, downloads = section.querySelector(".downloads");
  const sentences = identification ? identification.verdict : [row.status];
  at("verdict").replaceChildren(...sentences.map((sentence) => el("li", {}, sentence)));
  downloads.replaceChildren(...(identification ? [
    download(`api/results/${result}/report.html`, "Report"),
    download(`api/results/${result}/record.csv`, "Record"),
    download(`api/results/${result}/record.json`, "Sidecar"),
    download(`api/results/${result}/estimate.json`, "Estimate"),
  ] : []));
}
