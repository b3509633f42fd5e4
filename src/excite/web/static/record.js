// A recorded experiment: drop a file, map its columns, identify.

import { command, download, el, get, options, say, symbol, Task, tell, upload } from "./api.js";
import { digits, empty, Plot, range, shown } from "./plot.js";
import { rows } from "./view.js";

const section = document.getElementById("record"), form = section.querySelector("form");
const at = (id) => document.getElementById(id);
const NONE = " "; // of a choice of columns: there is none, but one value
let catalogue, task, given = null, reading = 0;

export function begin(known) {
  catalogue = known;
  task = new Task(form, () => given !== null && needed().every((name) => at(`column-${name}`)?.value));
  options(at("record-plant"), Object.keys(catalogue.plants), "aero2");
  options(at("estimator"), catalogue.estimators, "nls");
  at("record-plant").addEventListener("change", () => {
    ofPlant();
    if (given) { showMapping(); tellFiles(); }
  });
  at("effects").addEventListener("change", beforehand);
  ofPlant();
  at("file").addEventListener("change", () => take([...at("file").files]));
  at("more").accept = at("file").accept;
  at("more").addEventListener("change", () => take([...at("more").files], given));
  const drop = section.querySelector(".drop");
  const over = (is) => (event) => { event.preventDefault(); drop.classList.toggle("over", is); };
  section.addEventListener("dragover", over(true));
  section.addEventListener("dragleave", over(false));
  section.addEventListener("drop", (event) => { over(false)(event); take([...event.dataTransfer.files]); });
  at("side-by-side").querySelector("button").addEventListener("click", () => {
    task.kept.save({ results: task.kept.state.results.slice(-1) });
    at("side-by-side").hidden = true;
  });
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

/** Shows files that the server has read; columns as they were assigned if these are the files before, by names and columns, and one more. */
function put(taken) {
  const isAdded = given?.upload === taken.upload;
  given = taken;
  const mapped = JSON.stringify(given.files.map(({ file, columns }) => [file, Object.keys(columns)]));
  roles();
  showMapping();
  if (isAdded || mapped === task.kept.state.mapped) task.kept.fill();
  task.kept.save({ upload: given.upload, mapped });
  preview();
  task.refresh();
  tellFiles();
}

/** What the newest file has, and what is to be done next. */
function tellFiles() {
  const chosen = needed().map((name) => at(`column-${name}`).value), open = needed().filter((_, i) => !chosen[i]);
  const { file, columns } = given.files.at(-1), counts = Object.values(columns), lacking = chosen.filter((name) => name && name !== NONE && !(name in columns));
  const apart = Object.values(filled("held-out", signals()));
  if (lacking.length && at(`role-${given.files.length - 1}`).value !== "not used") {
    say(form, `${file} has no column ${lacking.join(", ")}: all files need the same names, or are not used.`, true);
    return;
  }
  say(form, `${file}: ${counts.length} ${counts.length > 1 ? "columns" : "column"}, ${Math.max(...counts)} samples. ${task.isBusy ? "Another file is still being identified; wait, or stop it." : open.length ? `Choose the column of ${open.join(", ")}.` : "Map them, then identify."}${apart.length ? ` Held out, as chosen under Advanced: ${apart.join(", ")}.` : ""}`);
}

/** Reads files, one after the other; they replace those before, or are added to them. */
async function take(chosen, before = null) {
  if (!chosen.length) return;
  const own = (reading += 1);
  let taken = before;
  if (!before) {
    given = null;
    task.refresh();
    if (!task.isBusy) hideResults();
    task.kept.save({ upload: null, shown: task.job });
    ["mapping", "files", "preview"].forEach((id) => { at(id).hidden = true; });
  }
  for (const one of chosen) {
    say(form, `Reading ${one.name}…`);
    try {
      taken = await upload(`api/uploads${taken ? `/${taken.upload}` : ""}?name=${encodeURIComponent(one.name)}`, one);
      if (own !== reading) return; // another was chosen while this one was read
      put(taken);
    } catch (error) {
      if (own === reading) say(form, error.message, true);
      return;
    }
  }
}

/** What each file is for. */
function roles() {
  at("files").hidden = false;
  at("more").value = "";
  at("files").querySelector("div").replaceChildren(...given.files.map(({ file }, i) => {
    const select = el("select", { id: `role-${i}` });
    options(select, ["fitted", "held out", "not used"]);
    select.addEventListener("change", tellFiles);
    return el("div", { class: "field" }, el("label", { for: select.id }, file), select);
  }));
}
const filesAs = (role) => given.files.map(({ file }) => file).filter((_, i) => at(`role-${i}`).value === role);

/** The first rows of the newest file, and a small plot of every column over its rows. */
function preview() {
  const file = given.files.at(-1), names = Object.keys(file.previews), rows = names.length ? file.previews[names[0]].first.length : 0;
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

/** What is chosen of a plant: its effects, what is known of it, and plants with the same inputs and outputs. */
function ofPlant() {
  effects();
  beforehand();
  const { constants, inputs, outputs } = plant(), signals = (p) => [...p.inputs, ...p.outputs].map(({ name }) => name).join();
  const like = Object.entries(catalogue.plants).filter(([name, p]) => name !== at("record-plant").value && signals(p) === signals({ inputs, outputs }));
  at("others").replaceChildren(...like.map(([name]) => el("label", {}, el("input", { id: `other-${name}`, type: "checkbox", value: name }), name)));
  at("others").parentElement.hidden = !like.length;
  at("uncertain").replaceChildren(...constants.map(({ name, unit }) => el("div", { class: "field" },
    el("label", { for: `uncertain-${name}` }, symbol(name), " ", el("span", { class: "unit" }, unit)),
    el("input", { id: `uncertain-${name}`, type: "text", placeholder: "exact", maxlength: 200, spellcheck: "false" }))));
  at("uncertain").parentElement.hidden = !constants.length;
}

const effects = () => at("effects").replaceChildren(...plant().effects.map((name) => el("label", {}, el("input", { id: `effect-${name}`, type: "checkbox", value: name }), name)));
const boxes = (id) => [...at(id).querySelectorAll("input")];
const checked = (id) => boxes(id).filter((box) => box.checked).map((box) => box.value);

/** A row a parameter, also of the chosen effects: its known value, the start of the search, or its prior. What was given stays. */
function beforehand() {
  const before = (id) => at(id)?.value ?? "";
  at("beforehand").replaceChildren(...estimated().map((name) => {
    const { unit = "", nominal = "" } = plant().parameters.find((p) => p.name === name) ?? {};
    const field = (kind, how, ...title) => el("div", { class: "field" }, el("label", { for: `${kind}-${name}` }, ...title), el("input", { id: `${kind}-${name}`, value: before(`${kind}-${name}`), ...how }));
    return el("div", { class: "known" },
      field("hold", { type: "number", step: "any", placeholder: "estimated" }, "hold ", symbol(name), " ", el("span", { class: "unit" }, unit)),
      field("start", { type: "number", step: "any", placeholder: nominal && shown(nominal) }, "start of ", symbol(name)),
      field("prior", { type: "text", placeholder: "none", maxlength: 200, spellcheck: "false" }, "prior of ", symbol(name)));
  }));
}

const estimated = () => [...plant().parameters.map((p) => p.name), ...checked("effects")];
/** What fields of a kind have, by the name of a parameter, a constant or a signal; those that are empty are left out. */
const filled = (kind, names, as = String) => Object.fromEntries(names.map((name) => [name, at(`${kind}-${name}`).value.trim()]).filter(([, text]) => text).map(([name, text]) => [name, as(text)]));

const plant = () => catalogue.plants[at("record-plant").value];
const inputs = () => plant().inputs.map((p) => p.name);
const signals = () => [...inputs(), ...plant().outputs.map((p) => p.name)];
const needed = () => ["time", ...signals()];
const unitsOf = (name) => [...plant().inputs, ...plant().outputs].find((p) => p.name === name)?.units ?? plant().units_of_time;
/** The unit that a column's name gives in brackets, such as "t [ms]" or "angle (deg)". */
const unitIn = (column) => /[[(]([^\])]+)[\])]\s*$/.exec(column)?.[1].trim();

function showMapping() {
  const there = Object.keys(given.files[0].columns), part = (name, kind) => there.find((c) => c.toLowerCase().replace("_", "") === name.toLowerCase() + kind); // uEst and uVal
  const found = (name) => there.find((c) => c.toLowerCase() === name.toLowerCase()) ?? there.find((c) => c.toLowerCase().split(/[\s([]/)[0] === name.toLowerCase()) ?? part(name, "est");
  at("mapping").hidden = false;
  at("mapping").querySelector("div").replaceChildren(...needed().map((name) => {
    const select = el("select", { id: `column-${name}` });
    const likely = found(name) ?? (name === "time" ? there.find((c) => /^(t|time|timestamps?|ts|dt)(?![a-z])/i.test(c)) : undefined);
    options(select, there, likely);
    if (likely === undefined) select.prepend(el("option", { value: "", selected: true }, "choose…"));
    const isOne = name === "time" || inputs().includes(name); // one value will do
    if (isOne) select.append(el("option", { value: NONE }, name === "time" ? "none: a sampling time" : "none: a constant"));
    const unit = el("select", { id: `unit-${name}` });
    const hint = el("p", { class: "hint", role: "status" });
    const guess = () => {
      const words = unitsOf(name).map((word) => word || "1"), word = unitIn(select.value);
      options(unit, words, word);
      hint.textContent = word === undefined || words.includes(word) ? "" : `unit "${word}" is not known: choose one`;
    };
    unit.addEventListener("change", () => { hint.textContent = ""; });
    const field = (id, title, input) => el("div", { class: "field" }, el("label", { for: id }, title, el("span", { class: "unseen" }, ` of ${name}`)), input);
    const number = (kind, how) => el("input", { id: `${kind}-${name}`, type: "number", step: "any", ...how });
    const value = field(`value-${name}`, name === "time" ? "sampling time dt [s]" : `value [${unitsOf(name)[0]}]`, number("value", {}));
    const units = [field(unit.id, "unit", unit), field(`scale-${name}`, "scale", number("scale", { placeholder: "none" }))];
    value.addEventListener("input", () => task.refresh());
    const change = () => {
      guess();
      const isNone = select.value === NONE;
      value.hidden = !isNone;
      value.lastChild.required = isNone;
      units.forEach((one) => { one.hidden = isNone; });
      task.refresh();
    };
    select.addEventListener("change", () => { change(); tellFiles(); });
    change();
    return el("div", { class: "map" }, el("div", { class: "field" }, el("label", { for: select.id }, name), select), ...units, value, hint);
  }));
  at("held-out").replaceChildren(...signals().map((name) => {
    const select = el("select", { id: `held-out-${name}` });
    options(select, there);
    select.prepend(el("option", { value: "" }, "the same"));
    select.value = part(name, "val") ?? "";
    select.addEventListener("change", tellFiles);
    return el("div", { class: "field" }, el("label", { for: select.id }, name), select);
  }));
  at("held-out").parentElement.hidden = false;
  task.refresh();
}

function asked() {
  const scales = {}, units = {}, columns = {}, one = {};
  for (const name of needed()) {
    if (at(`column-${name}`).value === NONE) { one[name] = +at(`value-${name}`).value; continue; }
    columns[name] = at(`column-${name}`).value;
    if (at(`scale-${name}`).value !== "") scales[name] = +at(`scale-${name}`).value;
    else if (at(`unit-${name}`).selectedIndex) units[name] = at(`unit-${name}`).value;
  }
  const { time: dt = null, ...set } = one, [fitted, apart] = ["fitted", "held out"].map(filesAs), other = filled("held-out", signals());
  return {
    upload: given.upload,
    fitted,
    held_out: apart.length || !Object.keys(other).length ? apart : fitted.slice(0, 1),
    plant: at("record-plant").value,
    effects: checked("effects"),
    others: checked("others"),
    columns,
    validate_columns: other,
    scales,
    units,
    set_inputs: set,
    dt,
    rows: at("rows").value.trim(),
    estimator: at("estimator").value,
    initial_state: at("initial").value,
    intervals: at("intervals").value,
    likelihood: at("likelihood").value,
    hold_input: at("hold-input").value,
    start: filled("start", estimated(), Number),
    hold: filled("hold", estimated(), Number),
    priors: filled("prior", estimated()),
    uncertain: filled("uncertain", plant().constants.map(({ name }) => name)),
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
  if (!found) return;
  show(wanted, found);
  if (request) section.querySelector(".view h2").scrollIntoView({ block: "nearest" });
}

const results = () => section.querySelectorAll(".view > section:not(#preview, #side-by-side)");
const hideResults = () => results().forEach((part) => { part.hidden = true; });

/** Shows what was found for a request. */
function show(wanted, { identification, plant: fitted, result, records, comparison, command: again }) {
  results().forEach((part) => { part.hidden = false; });
  say(form, `Done: ${identification.status}.`);
  section.querySelector(".view h2").textContent = `Identified: ${identification.files.join(", ")}, ${fitted.name}`;
  at("record-answer").replaceChildren(...identification.answer.map((text) => el("p", {}, text)));
  table(at("identified"), identification);
  at("record-verdict").replaceChildren(...identification.verdict.map((text) => el("li", {}, text)));
  section.querySelector(".downloads").replaceChildren(
    download(`api/results/${result}/report.html`, "Report"),
    ...(identification.files.length > 1 ? [] : [download(`api/results/${result}/record.csv`, "Record"), download(`api/results/${result}/record.json`, "Sidecar")]),
    download(`api/results/${result}/estimate.json`, "Estimate"));
  causes(wanted, identification.suspects ?? []);
  at("compared-plants").replaceChildren(...(comparison ? [el("h3", {}, comparison.title), rows(comparison, comparison.title),
    el("p", { class: "hint below" }, "All fitted alike: normal likelihood, all parameters free, no priors. BIC: the Bayesian information criterion, smaller is better. p: that of the first plant, against this one.")] : []));
  at("profiles").replaceChildren();
  starts(identification.starts ?? []);
  profiles(identification);
  correlations(Object.keys(identification.params), identification.correlation ?? []);
  at("record-again").replaceChildren(command(again));
  empty(at("record-signals"), at("residual-echoes"));
  records.forEach((record, k) => signalsOf(record, fitted, records.length > 1 ? `${record.file}${k < identification.files.length ? "" : ", held out"}: ` : ""));
  beside(result);
}

/** Input, output and residual of a record; `about` begins the titles. */
function signalsOf({ time: seconds, inputs, outputs, simulated, is_whole: isWhole }, fitted, about) {
  const parent = el("div", { class: `plots ${about && "own"}` }), [unit, size] = clock(seconds.at(-1) - seconds[0]);
  const time = seconds.map((t) => t / size), x = [time[0], time.at(-1)];
  at("record-signals").append(parent);
  const title = (part) => el("span", {}, about, part.name, " ", el("span", { class: "unit" }, part.shown_unit));
  fitted.inputs.forEach((part, i) => {
    const y = inputs.map((row) => row[i]);
    new Plot(parent, title(part), `${about}${part.name} over time`).show({ x, y: range(y, 0), unit, lines: [{ x: time, y, color: "input", step: true, width: 1.3 }] });
  });
  fitted.outputs.forEach((part, i) => {
    const measured = outputs.map((row) => row[i] * part.factor), model = simulated.map((row) => row[i] * part.factor);
    new Plot(parent, title(part), `${about}${part.name}, measured and simulated, over time`).show({
      x, y: range([...measured, ...model], 0), unit,
      lines: [{ x: time, y: measured, name: "measured", color: "output", points: true }, { x: time, y: model, name: "simulated", color: "simulated" }],
    });
    const left = measured.map((v, k) => v - model[k]);
    new Plot(parent, el("span", {}, "residual of ", title(part)), `${about}measured minus simulated ${part.name}`).show({
      x, y: range(left, 0), unit, lines: [{ x: time, y: left, color: "output", width: 1 }],
    });
    if (!isWhole) return;
    const { lags, values, bound } = echoes(left), most = lags.at(-1) + 0.5;
    new Plot(at("residual-echoes"), el("span", {}, "correlation of the residual of ", about, part.name), `${about}autocorrelation of the residual of ${part.name} over the lag in samples; white noise lies within the band in 95 %`).show({
      x: [0, most], y: range(values, -0.2, 0.2), unit: "samples", bands: [{ x: [0, most], lower: [-bound, -bound], upper: [bound, bound], color: "band" }],
      lines: [{ x: lags, y: values, color: "output", points: true }],
    });
  });
}

/** The unit in which a time is easily read, and how many seconds it has. */
const clock = (length) => [["d", 86400], ["h", 3600]].find(([, size]) => length >= 5 * size) ?? ["s", 1];

/** What was identified before, beside the newest; results that the server no longer has are left out. */
async function beside(newest) {
  const names = [...task.kept.state.results.filter((name) => name !== newest), newest].slice(-6);
  task.kept.save({ results: names });
  at("side-by-side").hidden = names.length < 2;
  if (names.length < 2) return;
  try {
    const found = await get(`api/results/compared?${names.map((name) => `name=${encodeURIComponent(name)}`).join("&")}`);
    at("side-by-side").hidden = found.header.length < 4;
    at("side-by-side").querySelector("div").replaceChildren(rows(found, found.title));
  } catch { at("side-by-side").hidden = true; }
}

/** The costs at which the starts of the search ended, the best first. */
function starts(costs) {
  const y = costs.filter(Number.isFinite).sort((a, b) => a - b), least = y[0], x = y.map((_, k) => k + 1);
  if (y.length < 2) return;
  const own = el("div", { class: "own" });
  at("profiles").append(own);
  new Plot(own, "starts of the search", "cost over the least at which each start of the search ended, the best first").show({
    x: [0.5, y.length + 0.5], y: range(y.map((cost) => cost / least), 0.8, 1.2), unit: "start", lines: [{ x, y: y.map((cost) => cost / least), name: "cost / least", color: "output", dots: true }],
  });
}

/** Buttons that estimate what the plant may leave out, too, the likeliest first. */
function causes(wanted, suspects) {
  const possible = suspects.filter(({ name }) => catalogue.plants[wanted.plant].effects.includes(name));
  at("causes").replaceChildren(...possible.slice(0, 3).map(({ name }, i) => el("button", {
    type: "button", click: () => {
      const more = { ...wanted, effects: [...wanted.effects, name] };
      if (at("record-plant").value === wanted.plant) boxes("effects").forEach((box) => { box.checked = more.effects.includes(box.value); });
      if (at("record-plant").value === wanted.plant) beforehand();
      identify(more);
    },
  }, i ? `Or estimate ${name}` : `Estimate ${name}, too`)));
}

/** The profile likelihoods: growth of the squares over its limit, with the ends of the interval. */
function profiles({ params, profiles: every }) {
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
