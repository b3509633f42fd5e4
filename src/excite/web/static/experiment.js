// Choose a plant and an excitation, run the experiment, watch the estimates.

import { command, download, el, get, options, say, symbol, Task, tell } from "./api.js";
import { COLOURS } from "./curves.js";
import { drawSignals, levelsOf, linesOf, passed, reach, signalPlots } from "./overlay.js";
import { digits, empty, Plot, range, shown } from "./plot.js";

const section = document.getElementById("experiment"), form = section.querySelector("form");
const at = (id) => document.getElementById(id);
let catalogue, plant, task, shownRun = null;

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
  const gone = task.kept.fill(), { shown: before } = task.kept.state;
  say(form, gone || "Ready.", Boolean(gone));
  if (before) again(before, gone);
  else prepared(gone);
}

/** Shows the result that was shown before the page was loaded, or else the prepared one and what is gone. */
async function again(name, gone) {
  const failure = await follow(`api/results/${name}/events`);
  if (!at("signals").querySelector("figure")) prepared(gone || failure);
  else if (gone) say(form, gone, true);
}

/** Draws the default experiment, as it was computed for this page. */
async function prepared(gone) {
  const events = await get("static/first.json"), others = events.filter(({ kind }) => kind === "other");
  if (task.isBusy || at("signals").querySelector("figure")) return;
  [{ kind: "job", asked: { others } }, ...events].forEach(follower());
  say(form, gone || "Ready. What is shown was prepared: chirp, PRBS and the policy aero2. Press Run for your own.", Boolean(gone));
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
    { label: "classical", group: names.filter((n) => !n.startsWith("loop-")) },
    { label: "in a position loop", group: names.filter((n) => n.startsWith("loop-")) },
    { label: "learned", group: policies },
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
  at("amplitude").dataset.usual = at("amplitude").value;
  section.querySelector("label[for=amplitude] .unit").textContent = isSignal ? `${input.unit}, at most ${half}` : "set by the excitation";
  const policy = plant.policies[name], longest = policy?.num_steps;
  at("about").textContent = policy ? "Learned: a policy that reacts to every measurement."
    : isSignal ? "Classical: a signal that is fixed beforehand." : "A classical signal as the reference of a position loop, which keeps the plant near it.";
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
  clear();
  say(form, "Waiting for a worker…");
  follow("api/experiments", asked());
}

/** Shows an experiment as it goes on: a new one, or without `wanted` one that was shown before. */
async function follow(address, wanted) {
  const failure = await task.run(address, wanted, follower(wanted));
  if (shownRun && !shownRun.isFull) shownRun.halt(); // no more samples come
  return failure;
}

/** Takes away what is shown of the run before. */
function clear() {
  shownRun?.halt();
  at("outcome").hidden = at("player").hidden = at("answer").hidden = true;
  empty(at("signals"), at("estimates"), at("overlays"));
}

/** Draws the events of an experiment and its comparisons. */
function follower(wanted) {
  let live = null, rows = [], total = 1;
  return (event) => {
    if (event.kind === "job") {
      clear();
      total += event.asked.others.length;
    } else if (event.kind === "started") say(form, "Preparing. The first run with a plant, a length or an excitation compiles programs, which can take a minute or two…");
    else if (event.kind === "plan") {
      live = new Live(event);
      if (wanted && matchMedia("(max-width: 60rem)").matches) section.querySelector(".view").scrollIntoView();
    } else if (event.kind === "samples") {
      live.samples(event);
      say(form, live.isFull ? waiting(live) : "Running.");
      tell(form, live.isFull ? "" : `${shown(live.time.at(-1))} of ${shown(live.end)} s`);
    } else if (event.kind === "estimate") {
      live.estimate(event);
      if (live.isFull) say(form, waiting(live));
    } else if (["result", "other", "left_out"].includes(event.kind)) {
      rows.push(event.row ?? event);
      if (event.traces) live.compared.push({ name: event.row.excitation, estimates: event.estimates, time: live.time, ...event.traces });
      compare(live, rows, total);
      overlay(live.plan, live.compared);
      live.track();
      if (event.kind === "result") conclude(event);
      if (rows.length === total) say(form, "Done.");
    }
  };
}

/** An experiment under way: what was measured so far, and the estimates. */
class Live {
  constructor(plan) {
    Object.assign(this, { plan, time: [], inputs: [], outputs: [], found: [], compared: [], until: null });
    shownRun = this;
    this.end = (plan.num_samples - 1) * plan.plant.dt;
    if (plan.warning) say(form, plan.warning, true);
    const title = (part) => el("span", {}, part.name, " ", el("span", { class: "unit" }, part.shown_unit));
    at("signals").parentElement.querySelector("h2").textContent = `Input and output: ${plan.plant.name}, ${plan.excitation}`;
    this.play();
    const from = (name) => el("span", {}, symbol(name), " ", el("span", { class: "unit" }, "% from the true value"));
    this.plots = [...plan.plant.inputs, ...plan.plant.outputs].map((part) =>
      new Plot(at("signals"), title(part), `${part.name} over time, with its safety levels`));
    this.tracks = plan.plant.parameters.map((p) =>
      new Plot(at("estimates"), from(p.name), `estimate of ${p.name} over time for every excitation, deviation from the true value in percent, 95 % interval and Cramér-Rao bounds`));
    this.draw();
  }

  get isFull() { return this.time.length === this.plan.num_samples; }

  samples({ time, inputs, outputs }) {
    this.time.push(...time);
    this.inputs.push(...inputs);
    this.outputs.push(...outputs);
    if (this.isFull && this.until === null) this.halt();
    this.draw();
  }

  /** How many samples are shown: all there are, unless it is paused. */
  get count() { return this.until ?? this.time.length; }

  /** Ends what is being played again. */
  halt() {
    cancelAnimationFrame(this.frame);
    at("player").querySelector("button").textContent = "Play";
  }

  /** The button that pauses and plays again, and the slider through what was recorded. */
  play() {
    const button = at("player").querySelector("button"), slider = at("shown-time");
    const move = (count) => { this.until = count; this.draw(); this.track(); };
    at("player").hidden = false;
    slider.max = this.plan.num_samples;
    button.textContent = "Pause";
    slider.oninput = () => { this.halt(); move(Math.min(+slider.value, this.time.length)); };
    button.onclick = () => {
      if (button.textContent === "Pause") { this.halt(); move(this.count); return; }
      button.textContent = "Pause";
      if (task.isBusy && !this.isFull) { this.until = null; this.draw(); return; }
      const first = this.count < this.time.length ? this.count : 0, length = 1000 * Math.min(10, this.end), begin = performance.now();
      const next = (now) => {
        move(Math.min(this.time.length, Math.round(first + ((now - begin) / length) * this.time.length)));
        if (this.count < this.time.length) this.frame = requestAnimationFrame(next); else this.halt();
      };
      this.frame = requestAnimationFrame(next);
    };
  }

  estimate(event) {
    this.found.push(event);
    this.track();
  }

  /** The estimates of every excitation up to the time that is shown, each with its bound; the interval of the first. */
  track() {
    const { plant, params, excitation } = this.plan, isSeen = ({ k }) => this.until === null || k < this.until;
    const every = [{ name: excitation, estimates: this.found }, ...this.compared.slice(1)].map((own) => ({ ...own, found: own.estimates.filter(isSeen) }));
    plant.parameters.forEach(({ name, scale, unit }, i) => {
      const true_ = params[name], per = 100 / (Math.abs(true_) || scale), reach = [], lines = [], bounds = [], bands = [];
      every.forEach(({ name: who, found }, j) => {
        const x = found.map(({ k }) => k * plant.dt), color = COLOURS[j];
        const column = (what) => found.map((e) => (e[what][name] === null ? null : e[what][name] * per));
        const y = column("estimate").map((v) => (v === null ? null : v - true_ * per)), half = column("half"), bound = column("bound");
        const good = found.map((_, k) => k).filter((k) => y[k] !== null);
        // The first estimates are far off: the scale follows the later ones.
        for (const k of good.filter((k) => k >= Math.floor(found.length / 2.5))) reach.push(Math.abs(y[k]) + (j ? 0 : half[k]), bound[k]);
        lines.push({ x, y, name: who, color, dots: true });
        for (const sign of [1, -1]) bounds.push({ x, y: bound.map((v) => (v === null ? null : sign * v)), name: `${who}, bound`, color, dash: [5, 4], width: 1.2 });
        if (!j) bands.push({ x: good.map((k) => x[k]), lower: good.map((k) => y[k] - half[k]), upper: good.map((k) => y[k] + half[k]), color: "band" });
      });
      const top = 1.15 * (Math.max(...reach.filter(Number.isFinite), 0) || 100);
      this.tracks[i].show({ x: [0, this.end], y: [-top, top], unit: "s", bands, lines: [...lines, ...bounds] });
      const { estimate, half } = every[0].found.at(-1) ?? { estimate: {}, half: {} }, last = estimate[name] ?? null;
      this.tracks[i].note.textContent = last === null ? "no estimate yet" : `${shown(last, digits(last, half[name]))} ± ${shown(half[name], 2)} ${unit}`;
    });
  }

  draw() {
    const { inputs, outputs } = this.plan.plant, x = [0, this.end], { count } = this;
    const time = this.time.slice(0, count), played = this.inputs.slice(0, count), seen = this.outputs.slice(0, count);
    at("shown-time").value = count;
    at("player").querySelector("output").textContent = `${shown(time.at(-1) ?? 0)} s`;
    inputs.forEach((part, i) => {
      const y = played.map((row) => row[i]);
      this.plots[i].show({
        x, y: range(this.inputs.map((row) => row[i]), -part.amplitude, part.amplitude), unit: "s",
        lines: [{ x: time.slice(0, y.length), y, color: "input", step: true, width: 1.3 }],
      });
    });
    outputs.forEach((part, i) => {
      const values = seen.map((row) => row[i] * part.factor), plot = this.plots[inputs.length + i];
      plot.show({
        x, y: reach(part, this.outputs.map((row) => row[i] * part.factor)), unit: "s", levels: levelsOf(part), marks: passed(part, time, values),
        lines: [{ x: time, y: values, color: "output" }],
      });
      // A violation is one of the true output, which the comparison shows.
      const largest = Math.max(...values.map(Math.abs), 0);
      plot.note.textContent = [`largest measured ${shown(largest)} ${part.shown_unit}`, ...passed(part, time, values).map(({ word }) => word)].join("; ");
    });
  }
}

/** All excitations in the same plots: inputs, true outputs, information and bounds over time. */
function overlay({ plant, num_samples: count }, compared) {
  const parent = at("overlays"), x = [0, (count - 1) * plant.dt], unit = "s";
  if (!compared.length) return;
  const bound = (name) => el("span", {}, "bound of ", symbol(name), " ", el("span", { class: "unit" }, "%")), all = "of all excitations over time";
  if (!parent.children.length) parent.plots = [
    ...signalPlots(parent, plant, all, "true "),
    new Plot(parent, "information, log det M", `information ${all}`),
    ...plant.parameters.map(({ name }) => new Plot(parent, bound(name), `Cramér-Rao bound of ${name} ${all}`)),
  ];
  const plots = [...parent.plots], lines = (more, pick) => linesOf(compared, more, pick);
  const after = (values) => [null, ...values]; // there is nothing before the first input
  drawSignals(plots.splice(0, plant.inputs.length + plant.outputs.length), plant, compared);
  const gained = lines({}, (own) => after(own.log_det)), seen = gained.flatMap(({ y }) => y.slice(Math.ceil(y.length / 10))).filter(Number.isFinite);
  plots.shift().show({ x, unit, y: range(seen), lines: gained });
  for (const { name } of plant.parameters) {
    const found = lines({}, (own) => after(own.bound_percent[name].map((v) => (v === null ? null : Math.log10(v))))), plot = plots.shift();
    const isKnown = ({ y }) => Number.isFinite(y.at(-1)), known = found.filter(isKnown), ends = known.length ? known.map(({ y }) => y.at(-1)) : [0];
    const low = Math.floor(Math.min(...ends)), high = Math.max(low + 2, Math.ceil(Math.max(...ends)) + 1);
    plot.show({ x, unit, log: true, y: [low, high], lines: found });
    plot.note.textContent = found.filter((line) => !isKnown(line)).map((line) => `${line.name}: not identifiable`).join("; ");
  }
}

/** Whether an output passed its critical level, or its warning level. */
function state(row, outputs) {
  if (row.is_violation) return "violation";
  if (outputs.every((o) => o.warning_level === null && o.critical_level === null)) return "no level";
  return outputs.some((o) => o.warning_level !== null && row.max_abs_output[o.name] >= o.warning_level) ? "warning" : "safe";
}

/** Which excitation tells most of those without a violation, by how much, and how near it came to a level. */
function answer(rows, { parameters, outputs }) {
  const worth = (row) => row.log_det_information ?? -Infinity, bound = (row) => parameters.reduce((sum, { name }) => sum + Math.log(row.params[name].cramer_rao_percent), 0) / parameters.length;
  const calm = rows.filter((row) => !row.is_violation).sort((a, b) => worth(b) - worth(a)), [best, next] = calm;
  if (!best || !Number.isFinite(worth(best))) return best ? "No excitation tells all parameters." : "Every excitation reached a critical level (violation): take a smaller amplitude, or a policy.";
  const loud = rows.filter((row) => row.is_violation).map(({ excitation }) => excitation).join(" and ");
  const told = { warning: "reached a warning level, but no critical one", safe: "reached no level", "no level": "has no level to reach: the plant declares none" }[state(best, outputs)];
  if (!next) return `${loud && `${loud} reached a critical level (violation). `}${best.excitation} ${told} in this experiment.`;
  const less = Math.exp(bound(next) - bound(best)), lead = Number.isFinite(less) ? `: the standard errors that it allows are ${shown(less, 2)} times smaller (geometric mean) than those of ${next.excitation}` : "";
  return `${loud && `${loud} reached a critical level (violation). `}Of ${loud ? "the others" : `these ${rows.length}`}, ${best.excitation} tells most${lead}. In this experiment it ${told}.`;
}

function compare(live, rows, total) {
  const { parameters, inputs, outputs } = live.plan.plant;
  const found = rows.filter((row) => row.params), calm = found.filter((row) => !row.is_violation);
  const least = (name) => Math.min(...calm.map((r) => r.params[name].cramer_rao_percent ?? Infinity)), most = Math.max(...calm.map((r) => r.log_det_information ?? -Infinity));
  const marked = (row, isBest) => ({ class: found.length > 1 && calm.includes(row) && isBest ? "best" : "" });
  const largest = (row, i) => Math.max(...(live.compared.find(({ name }) => name === row.excitation)?.inputs ?? []).map((u) => Math.abs(u[i])));
  const head = ["excitation", "safety", ...inputs.map((u) => `largest ${u.name} [${u.unit}]`), ...outputs.map((o) => `largest true ${o.name} [${o.shown_unit}]`)];
  at("outcome").querySelector("h2").textContent = `Comparison: ${live.plan.plant.name}, ${live.plan.num_samples - 1} samples`;
  at("comparison").replaceChildren(
    el("thead", {}, el("tr", {}, ...head.map((text) => el("th", { scope: "col" }, text)),
      ...parameters.map((p) => el("th", { scope: "col" }, symbol(p.name), " error (bound) %")), el("th", { scope: "col" }, "log det M"))),
    el("tbody", {}, ...rows.map((row) => (row.sentence ? el("tr", {}, el("th", { scope: "row" }, row.excitation),
      el("td", { class: "said", colspan: 2 + inputs.length + outputs.length + parameters.length }, row.sentence)) : el("tr", {},
      el("th", { scope: "row" }, row.excitation),
      el("td", { class: { violation: "bad", warning: "warned", safe: "good" }[state(row, outputs)] }, state(row, outputs)),
      ...inputs.map((_, i) => el("td", {}, shown(largest(row, i)))),
      ...outputs.map((o) => el("td", {}, shown(row.max_abs_output[o.name] * o.factor))),
      ...parameters.map(({ name }) => {
        const p = row.params[name];
        return el("td", marked(row, p.cramer_rao_percent === least(name)),
          shown(p.error_percent), " ", el("small", {}, `(${shown(p.cramer_rao_percent, 2)})`));
      }),
      el("td", marked(row, row.log_det_information === most), shown(row.log_det_information, 4)))))));
  at("outcome").hidden = false;
  if (rows.length < total) say(form, "Comparing…");
  else if (found.length) Object.assign(at("answer"), { hidden: false, textContent: answer(found, live.plan.plant) });
}

function conclude(event) {
  const { identification, row, result = null } = event, downloads = section.querySelector(".downloads");
  const sentences = identification ? identification.verdict : [row.status];
  at("verdict").replaceChildren(...sentences.map((sentence) => el("li", {}, sentence)));
  downloads.replaceChildren(...(identification && result ? [
    download(`api/results/${result}/report.html`, "Report"),
    download(`api/results/${result}/record.csv`, "Record"),
    download(`api/results/${result}/record.json`, "Sidecar"),
    download(`api/results/${result}/estimate.json`, "Estimate"),
  ] : []));
  at("again").replaceChildren(command(event.command));
}
