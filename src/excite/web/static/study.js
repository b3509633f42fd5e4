// A study: its answer, one row a method for the chosen estimator, and the frontier of its methods.

import { el, options } from "./api.js";
import { drawFrontier } from "./frontier.js";

let chosen = ""; // the estimator, also for the next study that has it

/** Cards of a study, as the server tells it. */
export function study({ sentences, estimator, tables, points, quantity, notes }) {
  const names = Object.keys(tables), select = el("select", { id: "study-estimator", change: () => { chosen = select.value; fill(); } });
  const shown = el("table"), marked = el("p", { class: "hint below" });
  options(select, names, names.includes(chosen) ? chosen : estimator);
  const cell = (text, isBest) => el("td", isBest ? { class: "best" } : {}, text, isBest ? el("span", { class: "unseen" }, " best") : null);
  function fill() {
    const { header, rows } = tables[select.value], isMarked = rows.some(({ best }) => best.length);
    shown.replaceChildren(
      el("thead", {}, el("tr", {}, ...header.map((text) => el("th", { scope: "col" }, text)))),
      el("tbody", {}, ...rows.map(({ cells: [name, ...cells], best }) => el("tr", {},
        el("th", { scope: "row" }, name), ...cells.map((text, i) => cell(text, best.includes(i + 1)))))));
    marked.textContent = isMarked ? "Bold: the best error, bound and information of the methods that are safe: without a violation, and with at most 5 % of failed estimates."
      : "No method is safe: without a violation, and with at most 5 % of failed estimates.";
  }
  fill();
  const parts = [
    ...sentences.map((text) => el("p", {}, text)),
    el("div", { class: "field", hidden: names.length < 2 }, el("label", { for: select.id }, "Estimator"), select),
    el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Table of the study" }, shown), marked,
    el("details", {}, el("summary", {}, "What the columns say"), ...notes.map((text) => el("p", { class: "hint below" }, text))),
  ];
  const drawn = points.filter(({ told }) => told !== null);
  if (drawn.length < 2) return { parts, card: null };
  const card = el("section", { class: "card" }, el("h2", {}, "Information against violations"));
  drawFrontier(card, drawn, quantity);
  return { parts, card };
}
