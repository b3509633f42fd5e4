// The run folder as a table: sorted, filtered, deleted from; what is chosen of it is shown below.

import { el, get, post, remove, say } from "./api.js";
import { compare } from "./compared.js";
import { recall, store } from "./kept.js";
import { show } from "./run.js";
import { clear } from "./view.js";

const section = document.getElementById("runs"), table = document.getElementById("run-list");
const filter = document.getElementById("run-filter"), body = table.querySelector("tbody");
const date = ({ changed }) => changed && new Date(changed).toLocaleString("sv").slice(0, 16); // 2026-11-27 08:15
const COLUMNS = { run: ({ name }) => name, date, plant: ({ plant }) => plant, kind: ({ kind }) => kind, "key figures": figures };
/** What stays in this tab of the browser, also after the page is loaded again. */
const state = recall("excite-runs", { column: "date", isDescending: true, words: "", deletions: [] });
const beside = document.getElementById("run-compare"), drop = document.getElementById("run-delete"), undo = document.getElementById("run-undo");
const everyBox = el("input", { type: "checkbox", change: () => {
  boxes().forEach((box) => { box.checked = everyBox.checked; });
  select();
} });
const labelled = (box, text) => el("td", {}, el("label", {}, box, el("span", { class: "unseen" }, text)));
let all = [], asked = "", chosen = [], selected = new Set();

filter.value = state.words;
filter.addEventListener("input", () => { state.words = filter.value; list(); });
beside.addEventListener("click", () => { location.hash = address([...selected]); });
drop.addEventListener("click", deleteSelected);
undo.addEventListener("click", restore);
table.querySelector("thead").append(el("tr", {}, labelled(everyBox, "Select all runs in the table"), ...Object.keys(COLUMNS).map((column) => el("th", { scope: "col" },
  el("button", { type: "button", click: () => {
    state.isDescending = state.column === column && !state.isDescending;
    state.column = column;
    list();
  } }, column)))));

function figures(run) {
  return run.is_finished ? run.key_figures : ["not finished", run.key_figures].filter(Boolean).join(": ");
}

/** The address of a run, or of a comparison of several: "#runs/frontier", "#runs/chirp,prbs". */
const address = (names) => `#runs/${names.map(encodeURIComponent).join(",")}`;

function namesIn(place) {
  try { return place.split(",").filter(Boolean).map(decodeURIComponent); } catch { return [place]; }
}

/** Lists the runs; those that the address names are shown, or else those that were chosen before. */
export async function open(place) {
  const names = place ? namesIn(place) : chosen, own = asked = address(names);
  try {
    all = (await get("api/runs")).runs;
    if (asked !== own) return; // the address changed while the list was loading
    say(section, all.length ? "" : "The run folder is empty; studies, identifications and records appear here.");
    const runs = names.map((name) => all.find((run) => run.name === name)), isThere = !runs.includes(undefined);
    chosen = isThere ? names : [];
    if (names.length > 1 && isThere) selected = new Set(names);
    list();
    if (!isThere) {
      clear();
      say(section, `The run folder has no run ${names.filter((_, i) => !runs[i]).join(", ")}.`, true);
    } else if (names.length > 1) await compare(names);
    else if (names.length) await show(runs[0]);
  } catch (error) {
    say(section, error.message, true);
  }
}

/** Shows the runs in which each word of the filter occurs, in the chosen order. */
function list() {
  store("sessionStorage", "excite-runs", state);
  const words = state.words.toLowerCase().split(/\s+/).filter(Boolean), sign = state.isDescending ? -1 : 1;
  const text = (run) => [run.title, ...Object.values(COLUMNS).map((cell) => cell(run))].join(" ").toLowerCase();
  const order = (a, b) => a.localeCompare(b, "en", { numeric: true }), key = COLUMNS[state.column] ?? date;
  const found = all.filter((run) => words.every((word) => text(run).includes(word)));
  found.sort((a, b) => sign * order(key(a), key(b)) || order(a.name, b.name));
  table.querySelectorAll("thead th").forEach((head) => {
    if (head.textContent === state.column) head.setAttribute("aria-sort", state.isDescending ? "descending" : "ascending");
    else head.removeAttribute("aria-sort");
  });
  const focused = body.contains(document.activeElement) ? document.activeElement : null;
  selected = new Set(found.map(({ name }) => name).filter((name) => selected.has(name))); // what is not seen is not selected
  body.replaceChildren(...found.map((run) => el("tr", { "data-name": run.name },
    labelled(el("input", { type: "checkbox", checked: selected.has(run.name), change: select }), `Select ${run.name}`),
    el("th", { scope: "row" }, el("a", { href: address([run.name]), "aria-current": chosen.includes(run.name) && "true" }, run.name)),
    ...Object.values(COLUMNS).slice(1).map((cell) => el("td", {}, cell(run))))));
  if (focused) [...body.rows].find(({ dataset }) => dataset.name === focused.closest("tr").dataset.name)?.querySelector(focused.localName).focus();
  document.getElementById("run-count").textContent = found.length < all.length ? `${found.length} of ${all.length} runs` : `${all.length} runs`;
  select();
}

const boxes = () => [...body.querySelectorAll("input")];
const count = (names) => (names.length === 1 ? names[0] : `${names.length} runs`);
const listed = (names) => (names.length > 5 ? count(names) : names.join(", "));

/** Which runs are selected, and what can be done with them. */
function select() {
  const chosenBoxes = boxes().filter(({ checked }) => checked);
  selected = new Set(chosenBoxes.map((box) => box.closest("tr").dataset.name));
  everyBox.checked = selected.size > 0 && selected.size === boxes().length;
  everyBox.indeterminate = selected.size > 0 && !everyBox.checked;
  drop.disabled = !selected.size;
  beside.disabled = selected.size < 2;
  undo.hidden = !state.deletions.length;
  if (!undo.hidden) undo.textContent = `Undo deletion of ${count(state.deletions.at(-1).names)}`;
}

/** Deletes what is selected; the run that is shown is taken away with it. */
async function deleteSelected() {
  const names = [...selected];
  drop.disabled = true; // not twice
  try {
    const { deletion } = await post("api/deletions", { names });
    state.deletions.push({ deletion, names });
    if (names.some((name) => chosen.includes(name))) {
      chosen = [];
      clear();
      history.replaceState(null, "", "#runs");
    }
    await relist(`Deleted: ${listed(names)}.`);
    undo.focus();
  } catch (error) {
    say(section, error.message, true);
    select();
  }
}

/** Undoes the last deletion. */
async function restore() {
  try {
    const { names } = await remove(`api/deletions/${state.deletions.at(-1).deletion}`);
    state.deletions.pop();
    await relist(`Restored: ${listed(names)}.`);
    [...body.rows].find(({ dataset }) => names.includes(dataset.name))?.querySelector("a").focus();
  } catch (error) {
    if (error.status === 404) state.deletions.pop(); // it is no longer on the disk
    say(section, error.message, true);
    list();
  }
}

async function relist(sentence) {
  all = (await get("api/runs")).runs;
  list();
  say(section, sentence);
}
