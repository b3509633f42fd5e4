// One run of the run folder: its tables, figures, learning curves and files.

import { download, el, get, say } from "./api.js";
import { signals } from "./compared.js";
import { curves } from "./curves.js";
import { table } from "./record.js";
import { study } from "./study.js";
import { clear, isWanted, put, rows } from "./view.js";

const section = document.getElementById("runs"), view = document.getElementById("run-view");
let following = 0;

/** Shows a run, and follows a campaign that goes on. */
export async function show(run) {
  if (!isWanted(run.name)) clear(run.name);
  clearTimeout(following);
  say(section, "");
  const name = encodeURIComponent(run.name), address = (file) => `api/run/file?name=${name}&file=${encodeURIComponent(file)}`;
  try {
    const content = await get(`api/run?name=${name}`);
    if (!isWanted(run.name)) return; // another was chosen while this one was loading
    const card = el("section", { class: "card" }, el("h2", {}, content.title || run.name));
    if (content.kind === "experiment") card.append(el("p", {}, content.key_figures));
    if (content.estimate.params) {
      const estimate = el("table");
      table(estimate, content.estimate);
      card.append(el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Table of parameters" }, estimate), el("ul", {}, ...(content.estimate.verdict ?? []).map((text) => el("li", {}, text))));
    }
    const told = content.study.tables ? study(content.study) : null;
    if (told) card.append(...told.parts);
    else if (content.rows.length) card.append(rows(content, "Table of the study"), ...content.notes.map((note) => el("p", { class: "hint" }, note)));
    if (content.campaign.told) card.append(el("p", {}, content.campaign.told));
    if (content.campaign.known) card.append(rows(content.campaign.known, "What is known"), el("h3", {}, "Rounds"), rows(content.campaign.rounds, "Rounds"));
    const link = (file) => download(address(file), file), isPolicy = (file) => file.endsWith(".safetensors");
    const policies = content.files.filter(isPolicy), others = content.files.filter((file) => !isPolicy(file));
    const report = content.is_finished ? [download(`api/run/report.html?name=${name}`, "Report")] : [];
    if (!content.is_finished && content.kind === "experiment") card.append(el("p", {}, "It is still being recorded, or its process was killed."));
    else if (content.campaign.now) card.append(el("p", { role: "status" }, content.campaign.now));
    else if (!content.is_finished) card.append(el("p", {}, "Not finished. To resume it after an interruption, rerun the command in the folder where it was started: ", el("code", {}, content.command || "the same command")));
    card.append(el("p", { class: "row downloads" }, ...report, ...others.map(link)));
    if (policies.length) card.append(el("details", { open: policies.length < 4 }, el("summary", {}, `Policies (${policies.length})`), el("p", { class: "row downloads" }, ...policies.map(link))));
    const isFollowed = content.kind === "campaign" && !content.is_finished && (content.campaign.now || !content.campaign.interrupted);
    if (isFollowed) following = setTimeout(() => isWanted(run.name) && !section.hidden && show(run), 2000);
    put(card, ...(told?.card ? [told.card] : []));
    if (content.curves.length) {
      const learnt = el("section", { class: "card" }, el("h2", {}, "Learning curves"), el("div", { class: "plots small" }));
      view.append(learnt);
      curves(learnt.querySelector(".plots"), content.curves);
    }
    for (const figure of content.figures) {
      view.append(el("section", { class: "card" }, el("h2", {}, figure.replace(/\.png$/, "")), el("img", { src: address(figure), alt: `figure ${figure} of ${run.name}`, loading: "lazy" })));
    }
    if (["experiment", "identification"].includes(content.kind)) await signals(run.name);
  } catch (error) {
    if (isWanted(run.name)) say(section, error.message, true);
  }
}
