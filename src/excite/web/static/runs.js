// The run folder as a table: sorted, filtered; one of its runs is shown below.

import { el, get, say } from "./api.js";
import { clear, show } from "./run.js";

const section = document.getElementById("runs"), table = document.getElementById("run-list");
const filter = document.getElementById("run-filter"), body = table.querySelector("tbody");
const date = ({ changed }) => changed && new Date(changed).toLocaleString("sv").slice(0, 16); // 2026-11-27 08:15
const COLUMNS = { run: ({ name }) => name, date, plant: ({ plant }) => plant, kind: ({ kind }) => kind, "key figures": figures };
/** What stays in this tab of the browser, also after the page is loaded again. */
const state = { column: "date", isDescending: true, words: "", ...JSON.parse(sessionStorage.getItem("runs")) };
let all = [], asked = "", chosen = "";

filter.value = state.words;
filter.addEventListener("input", () => { state.words = filter.value; list(); });
table.querySelector("thead").append(el("tr", {}, ...Object.keys(COLUMNS).map((column) => el("th", { scope: "col" },
  el("button", { type: "button", click: () => {
    state.isDescending = state.column === column && !state.isDescending;
    state.column = column;
    list();
  } }, column)))));

function figures(run) {
  return run.is_finished ? run.figures : ["not finished", run.figures].filter(Boolean).join(": ");
}

/** Lists the runs; the one that the address names is shown, or else the one that was chosen before. */
export async function open(wanted) {
  const name = wanted || chosen;
  asked = name;
  try {
    all = (await get("api/runs")).runs;
    if (asked !== name) return; // the address changed while the list was loading
    say(section, all.length ? "" : "The run folder is empty; studies and identifications appear here.");
    const run = all.find((each) => each.name === name);
    chosen = run ? name : "";
    list();
    if (run) await show(run);
    else if (name) {
      clear();
      say(section, `The run folder has no run ${name}.`, true);
    }
  } catch (error) {
    say(section, error.message, true);
  }
}

/** Shows the runs in which each word of the filter occurs, in the chosen order. */
function list() {
  sessionStorage.setItem("runs", JSON.stringify(state));
  const words = state.words.toLowerCase().split(/\s+/).filter(Boolean), sign = state.isDescending ? -1 : 1;
  const text = (run) => [run.title, ...Object.values(COLUMNS).map((cell) => cell(run))].join(" ").toLowerCase();
  const compare = (a, b) => a.localeCompare(b, "en", { numeric: true }), key = COLUMNS[state.column] ?? date;
  const found = all.filter((run) => words.every((word) => text(run).includes(word)));
  found.sort((a, b) => sign * compare(key(a), key(b)) || compare(a.name, b.name));
  table.querySelectorAll("thead th").forEach((head) => {
    if (head.textContent === state.column) head.setAttribute("aria-sort", state.isDescending ? "descending" : "ascending");
    else head.removeAttribute("aria-sort");
  });
  const focused = body.contains(document.activeElement) ? document.activeElement.hash : null;
  body.replaceChildren(...found.map((run) => el("tr", {},
    el("th", { scope: "row" }, el("a", { href: `#runs/${encodeURIComponent(run.name)}`, "aria-current": run.name === chosen && "true" }, run.name)),
    ...Object.values(COLUMNS).slice(1).map((cell) => el("td", {}, cell(run))))));
  [...body.querySelectorAll("a")].find(({ hash }) => hash === focused)?.focus();
  document.getElementById("run-count").textContent = found.length < all.length ? `${found.length} of ${all.length} runs` : `${all.length} runs`;
}
