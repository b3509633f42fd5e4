// What is shown below the table of runs, and tables of texts in it.

import { el } from "./api.js";

const section = document.getElementById("runs"), view = document.getElementById("run-view");
let shown = "";

/** Takes away what is shown; what is asked for next has a name. */
export function clear(next = "") {
  shown = next;
  view.replaceChildren();
}

/** Whether what was asked for by this name is still wanted. */
export const isWanted = (name) => shown === name;

/** Shows something that was asked for; what is new is brought into sight. */
export function put(...parts) {
  const isNew = !view.children.length;
  view.replaceChildren(...parts);
  if (isNew && !section.hidden && view.getBoundingClientRect().top > innerHeight / 2) view.scrollIntoView();
}

/** A table of texts. */
export const rows = ({ header, rows: cells }, name) => el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": name },
  el("table", {},
    el("thead", {}, el("tr", {}, ...header.map((text) => (text ? el("th", { scope: "col" }, text) : el("td"))))),
    el("tbody", {}, ...cells.map((row) => el("tr", {}, ...row.map((text, i) => (i ? el("td", {}, text) : el("th", { scope: "row" }, text))))))));
