// A recorded experiment: drop a file, map its columns, identify.

import { command, download, el, get, options, say, symbol, Task, tell, upload } from "./api.js";
import { digits, empty, Plot, range, shown } from "./plot.js";

const section = document.getElementById("record"), form = section.querySelector("form");
const at = (id) => document.getElementById(id);
let catalogue, task, file = null, reading = 0;

export function begin(known) {
  catalogue = known;
  task = new Task(form, () => file !== null && needed().every((name) => at(`column-${name}`)?.value));
  options(at("record-plant"), Object.keys(catalogue.plants), "aero2");
  options(at("estimator"), catalogue.estimators, "nls");
  at("record-plant").addEventListener("change", () => { effects(); beforehand(); showMapping(); });
  at("effects").addEventListener("change", beforehand);
  effects();
  beforehand();
  at("file").addEventListener("change", () => take(at("file").files[0]));
  const drop = section.querySelector(".drop");
  const over = (is) => (event) => { event.preventDefault(); drop.classList.toggle("over", is); };
  section.addEventListener("dragover", over(true));
  section.addEventListener("dragleave", over(false));
  section.addEventListener("drop", (event) => { over(false)(event); take(event.dataTransfer.files[0]); });
  form.addEventListener("submit", (event) => { event.preventDefault(); identify(asked()); });
  again(task.kept.fill());
}

/** Shows again the file and the result that were shown before the page was loaded, or says what is gone. */
async function again(gone) {
  const own = reading, { upload: name, shown: before } = task.kept.state;
  try {
    const taken = name && await get(`api/uploads/${name}`);
    if (own === reading && taken) put(taken);
  } catch (error) {
    gone ||= error.message;
  }
  if (own === reading && before) await follow(`api/results/${before}/events`);
  if (own === reading && gone) say(form, gone, true);
}

/** Shows a file that the server has read; its columns as they were assigned if it is the one before, by name and columns. */
function put(taken) {
  file = taken;
  const mapped = JSON.stringify([file.file, Object.keys(file.columns)]);
  showMapping();
  if (mapped === task.kept.state.mapped) task.kept.fill();
  task.kept.save({ upload: file.upload, mapped });
  preview();
  task.refresh();
  const counts = Object.values(file.columns);
  say(form, `${file.file}: ${counts.length} columns, ${Math.max(...counts)} samples. ${task.isBusy ? "Another file is still being identified; wait, or stop it." : "Map them, then identify."}`);
}

async function take(chosen) {
  if (!chosen) return;
  const own = (reading += 1);
  file = null;
  task.refresh();
  if (!task.isBusy) hideResults();
  task.kept.save({ upload: null, shown: task.job });
  at("mapping").hidden = true;
  say(form, `Reading ${chosen.name}…`);
  try {
    const taken = await upload(`api/uploads?name=${encodeURIComponent(chosen.name)}`, chosen);
    if (own !== reading) return; // another was chosen while this one was read
    put(taken);
  } catch (error) {
    if (own === reading) say(form, error.message, true);
  }
}

/** The first rows of the file, and a small plot of every column over its rows. */
function preview() {
  const names = Object.keys(file.previews), rows = names.length ? file.previews[names[0]].first.length : 0;
  at("preview").hidden = !names.length;
  at("preview").querySelector("h2").textContent = `The file: ${file.file}`;
  at("first-rows").replaceChildren(
    el("thead", {}, el("tr", {}, ...names.map((name) => el("th", { scope: "col" }, name)))),
    el("tbody", {}, ...Array.from({ length: rows }, (_, k) => el("tr", {}, ...names.map((name) => cell(file.previews[name].first[k] ?? ""))))));
  empty(at("columns"));
  for (const name of names) {
    const { index: x, values: y } = file.previews[name];
    if (y.length < 2) continue;
    const plot = new Plot(at("columns"), name, `column ${name} over the rows`);
    plot.note.textContent = file.previews[name].note;
    plot.show({ x: [0, x.at(-1)], y: range(y, y[0] ?? 0), unit: "row", lines: [{ x, y, color: "output" }] });
  }
}

/** A cell of the file: a number with a fraction has six digits, or three behind the point; its title is the whole of it. */
function cell(text) {
  if (!/^-?\d*\.\d+(e[-+]?\d+)?$/i.test(text)) return el("td", {}, text);
  const value = +(+text).toPrecision(Math.max(6, String(Math.trunc(Math.abs(text))).length + 3));
  return el("td", { title: value !== +text && text }, value && Math.abs(value) < 1e-4 ? value.toExponential() : String(value));
}

const effects = () => at("effects").replaceChildren(...plant().effects.map((name) => el("label", {}, el("input", { id: `effect-${name}`, type: "checkbox", value: name }), name)));
const boxes = () => [...at("effects").querySelectorAll("input")];

/** A row a parameter, also of the chosen effects: its known value, or its prior. What was given stays. */
function beforehand() {
  const given = (id) => at(id)?.value ?? "";
  at("beforehand").replaceChildren(...estimated().map((name) => {
    const [hold, prior] = [`hold-${name}`, `prior-${name}`], input = (id, how) => el("input", { id, value: given(id), ...how });
    const { unit = "" } = plant().parameters.find((p) => p.name === name) ?? {};
    return el("div", { class: "known" },
      el("div", { class: "field" }, el("label", { for: hold }, "hold ", symbol(name), " ", el("span", { class: "unit" }, unit)), input(hold, { type: "number", step: "any", placeholder: "estimated" })),
      el("div", { class: "field" }, el("label", { for: prior }, "prior of ", symbol(name)), input(prior, { type: "text", placeholder: "none", maxlength: 200, spellcheck: "false" })));
  }));
}

const estimated = () => [...plant().parameters.map((p) => p.name), ...boxes().filter((box) => box.checked).map((box) => box.value)];
/** What is given of the parameters: numbers that are held, or priors. */
const given = (kind, as) => Object.fromEntries(estimated().map((name) => [name, at(`${kind}-${name}`).value.trim()]).filter(([, text]) => text).map(([name, text]) => [name, as(text)]));

const plant = () => catalogue.plants[at("record-plant").value];
const needed = () => ["time", ...plant().inputs.map((p) => p.name), ...plant().outputs.map((p) => p.name)];
const unitsOf = (name) => [...plant().inputs, ...plant().outputs].find((p) => p.name === name)?.units ?? plant().units_of_time;
/** The unit that a column's name gives in brackets, such as "t [ms]" or "angle (deg)". */
const unitIn = (column) => /[[(]([^\])]+)[\])]\s*$/.exec(column)?.[1].trim();

function showMapping() {
  if (file === null) return;
  const there = Object.keys(file.columns), found = (name) => there.find((c) => c.toLowerCase() === name.toLowerCase()) ?? there.find((c) => c.toLowerCase().split(/[\s([]/)[0] === name.toLowerCase());
  at("mapping").hidden = false;
  at("mapping").querySelector("div").replaceChildren(...needed().map((name) => {
    const select = el("select", { id: `column-${name}` });
    const likely = found(name) ?? (name === "time" ? there.find((c) => /^(t|time|timestamps?)(?![a-z])/i.test(c)) : undefined);
    options(select, there, likely);
    if (likely === undefined) select.prepend(el("option", { value: "", selected: true }, "choose…"));
    const unit = el("select", { id: `unit-${name}` });
    const hint = el("p", { class: "hint", role: "status" });
    const guess = () => {
      const words = unitsOf(name).map((word) => word || "1"), word = unitIn(select.value);
      options(unit, words, word);
      hint.textContent = word === undefined || words.includes(word) ? "" : `unit "${word}" is not known: choose one`;
    };
    unit.addEventListener("change", () => { hint.textContent = ""; });
    select.addEventListener("change", () => { guess(); task.refresh(); });
    guess();
    return el("div", { class: "map" },
      el("div", { class: "field" }, el("label", { for: select.id }, name), select),
      el("div", { class: "field" }, el("label", { for: unit.id }, "unit", el("span", { class: "unseen" }, ` of ${name}`)), unit),
      el("div", { class: "field" }, el("label", { for: `scale-${name}` }, "scale", el("span", { class: "unseen" }, ` of ${name}`)),
        el("input", { id: `scale-${name}`, type: "number", step: "any", placeholder: "none" })),
      hint);
  }));
  task.refresh();
}

function asked() {
  const scales = {}, units = {};
  for (const name of needed()) {
    if (at(`scale-${name}`).value !== "") scales[name] = +at(`scale-${name}`).value;
    else if (at(`unit-${name}`).selectedIndex) units[name] = at(`unit-${name}`).value;
  }
  return {
    upload: file.upload,
    plant: at("record-plant").value,
    columns: Object.fromEntries(needed().map((name) => [name, at(`column-${name}`).value])),
    scales,
    units,
    estimator: at("estimator").value,
    initial_state: at("initial").value,
    effects: boxes().filter((box) => box.checked).map((box) => box.value),
    hold_input: at("hold-input").value,
    intervals: at("intervals").value,
    hold: given("hold", Number),
    priors: given("prior", String),
  };
}

function identify(wanted) {
  hideResults();
  say(form, "Waiting for a worker…");
  follow("api/identifications", wanted);
}

/** Shows what is found: for a new request, or without one for that which the address names. */
async function follow(address, request) {
  let wanted = null, found = null, seconds = 0;
  await task.run(address, request, (event) => {
    if (event.kind === "job") wanted = event.asked;
    else if (event.kind === "started") say(form, "Identifying…");
    else if (event.kind === "pulse") tell(form, `${(seconds += 1)} s`);
    else if (event.kind === "identified") found = event;
  });
  if (found) show(wanted, found);
}

const results = () => section.querySelectorAll(".view > section:not(#preview)");
const hideResults = () => results().forEach((part) => { part.hidden = true; });

/** Shows what was found for a request. */
function show(wanted, { identification, plant: fitted, result, time, inputs, outputs, simulated, is_whole: isWhole, command: again }) {
  results().forEach((part) => { part.hidden = false; });
  say(form, `Done: ${identification.status}.`);
  section.querySelector(".view h2").textContent = `Identified: ${identification.files.join(", ")}, ${fitted.name}`;
  table(at("identified"), identification);
  const fits = Object.entries(identification.fit_percent).filter(([, value]) => value !== null).map(([name, value]) => `${name}: fit ${shown(value, 4)} %${tests(identification, name)}`);
  at("record-verdict").replaceChildren(...[...fits, ...identification.verdict].map((text) => el("li", {}, text)));
  section.querySelector(".downloads").replaceChildren(
    download(`api/results/${result}/report.html`, "Report"),
    download(`api/results/${result}/record.csv`, "Record"),
    download(`api/results/${result}/record.json`, "Sidecar"),
    download(`api/results/${result}/estimate.json`, "Estimate"));
  causes(wanted, identification.suspects ?? []);
  profiles(identification);
  correlations(Object.keys(identification.params), identification.correlation ?? []);
  at("record-again").replaceChildren(command(again));
  const parent = at("record-signals"), x = [time[0], time.at(-1)];
  empty(parent, at("residual-echoes"));
  const title = (part) => el("span", {}, part.name, " ", el("span", { class: "unit" }, part.shown_unit));
  fitted.inputs.forEach((part, i) => {
    const y = inputs.map((row) => row[i]);
    new Plot(parent, title(part), `${part.name} over time`).show({ x, y: range(y, 0), unit: "s", lines: [{ x: time, y, color: "input", step: true, width: 1.3 }] });
  });
  fitted.outputs.forEach((part, i) => {
    const measured = outputs.map((row) => row[i] * part.factor), model = simulated.map((row) => row[i] * part.factor);
    new Plot(parent, title(part), `${part.name}, measured and simulated, over time`).show({
      x, y: range([...measured, ...model], 0), unit: "s",
      lines: [{ x: time, y: measured, name: "measured", color: "output", points: true }, { x: time, y: model, name: "simulated", color: "simulated" }],
    });
    const left = measured.map((v, k) => v - model[k]);
    new Plot(parent, el("span", {}, "residual of ", title(part)), `measured minus simulated ${part.name}`).show({
      x, y: range(left, 0), unit: "s", lines: [{ x: time, y: left, color: "output", width: 1 }],
    });
    if (!isWhole) return;
    const { lags, values, bound } = echoes(left), most = lags.at(-1) + 0.5;
    new Plot(at("residual-echoes"), el("span", {}, "correlation of the residual of ", part.name), `autocorrelation of the residual of ${part.name} over the lag in samples; white noise lies within the band in 95 %`).show({
      x: [0, most], y: range(values, -0.2, 0.2), unit: "samples", bands: [{ x: [0, most], lower: [-bound, -bound], upper: [bound, bound], color: "band" }],
      lines: [{ x: lags, y: values, color: "output", points: true }],
    });
  });
}

/** Buttons that estimate what the plant may leave out, too, the likeliest first. */
function causes(wanted, suspects) {
  const possible = suspects.filter(({ name }) => catalogue.plants[wanted.plant].effects.includes(name));
  at("causes").replaceChildren(...possible.slice(0, 3).map(({ name }, i) => el("button", {
    type: "button", click: () => {
      const more = { ...wanted, effects: [...wanted.effects, name] };
      if (at("record-plant").value === wanted.plant) boxes().forEach((box) => { box.checked = more.effects.includes(box.value); });
      if (at("record-plant").value === wanted.plant) beforehand();
      identify(more);
    },
  }, i ? `Or estimate ${name}` : `Estimate ${name}, too`)));
}

/** The profile likelihoods: growth of the squares over its limit, with the ends of the interval. */
function profiles({ params, profiles: every }) {
  at("profiles").replaceChildren();
  for (const [name, points] of Object.entries(every ?? {})) {
    const drawn = points.filter(([value, growth]) => Number.isFinite(value) && Number.isFinite(growth) && growth < 5).sort(([a], [b]) => a - b);
    if (drawn.length < 2) continue;
    const x = drawn.map(([value]) => value), y = drawn.map(([, growth]) => Math.max(0, growth)), ends = [x[0], x.at(-1)];
    const own = el("div", { class: "own" });
    at("profiles").append(own);
    new Plot(own, el("span", {}, "profile of ", symbol(name)), `profile likelihood of ${name}: growth of the squares over the limit of the 95 % interval`).show({
      x: ends, y: range(y, 0, 1), unit: params[name].unit,
      lines: [{ x, y, name: "growth / limit", color: "output", dots: true }, { x: ends, y: [1, 1], name: "95 %", color: "bound", dash: [6, 4] }],
      marks: (params[name].ci95 ?? []).filter(Number.isFinite).map((end) => ({ x: end, color: "soft", word: "" })),
    });
  }
}

/** The correlations as a table, the stronger the darker. */
function correlations(names, rows) {
  at("correlations").hidden = rows.length < 2;
  const cell = (value) => {
    const shade = el("td", {}, value === null ? "–" : value.toFixed(2));
    if (value !== null) shade.style.background = `color-mix(in srgb, var(--${value < 0 ? "simulated" : "output"}) ${Math.round(35 * Math.abs(value))}%, transparent)`;
    return shade;
  };
  at("correlations").querySelector("table").replaceChildren(
    el("thead", {}, el("tr", {}, el("td"), ...names.map((name) => el("th", { scope: "col" }, symbol(name))))),
    el("tbody", {}, ...rows.map((row, i) => el("tr", {}, el("th", { scope: "row" }, symbol(names[i])), ...row.map(cell)))));
}

/** The correlation of a residual with itself, of up to so many samples later. */
function echoes(left, most = 30) {
  const seen = left.filter(Number.isFinite), mean = seen.reduce((a, b) => a + b, 0) / seen.length;
  const own = left.map((v) => (Number.isFinite(v) ? v - mean : 0)), power = own.reduce((a, v) => a + v * v, 0) || 1;
  const lags = Array.from({ length: Math.min(most, left.length - 1) }, (_, k) => k + 1);
  return { lags, values: lags.map((k) => own.slice(k).reduce((a, v, i) => a + v * own[i], 0) / power), bound: 1.96 / Math.sqrt(seen.length) };
}

/** What the tests of a residual say; the verdict says what follows from a small p. */
function tests({ whiteness_p_value: white, structure_p_value: follows }, name) {
  if (!Number.isFinite(white?.[name]) || !Number.isFinite(follows?.[name])) return "";
  return `; residual white with p = ${shown(white[name])}, independent of the input with p = ${shown(follows[name])}`;
}

const interval = ({ estimate, std_error: sd, ci95 }) => (Number.isFinite(ci95?.[0])
  ? ci95.map((end) => shown(end, digits(estimate, sd))).join(" to ") : "–");

/** The parameters of an identification as a table. */
export function table(element, { params }) {
  element.replaceChildren(
    el("thead", {}, el("tr", {}, ...["parameter", "estimate", "95 % interval", "standard error", "unit"].map((text) => el("th", { scope: "col" }, text)))),
    el("tbody", {}, ...Object.entries(params).map(([name, p]) => el("tr", {},
      el("th", { scope: "row" }, symbol(name)),
      el("td", {}, shown(p.estimate, digits(p.estimate, p.std_error)) + (p.held ? " (held)" : "")),
      el("td", {}, interval(p)),
      el("td", {}, shown(p.std_error)),
      el("td", {}, p.unit)))));
}
