// The whole page: its parts, the token, the lists to choose from.

import { get, post, say } from "./api.js";
import * as experiment from "./experiment.js";
import * as record from "./record.js";
import * as runs from "./runs.js";
import * as training from "./training.js";

const parts = { experiment: null, record: null, runs, training };
const isPart = (word) => Object.hasOwn(parts, word);
/** The part of the page that the address names, and what in it, as it is encoded there: "#runs/frontier". */
function place() {
  const [word, what = ""] = location.hash.slice(1).split(/\/(.*)/s);
  return [word, what];
}
const door = document.getElementById("door");

function turn() {
  if (location.hash === "#main") return; // the link that skips the header
  const [word, what] = place(), name = isPart(word) ? word : "experiment";
  for (const part of Object.keys(parts)) document.getElementById(part).hidden = part !== name;
  document.querySelectorAll("nav a").forEach((link) => {
    if (link.hash === `#${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  });
  parts[name]?.open(what);
}

async function enter() {
  door.hidden = true;
  addEventListener("hashchange", turn);
  turn();
  try {
    const catalogue = await get("api/catalogue");
    [experiment, record, training].forEach((part) => part.begin(catalogue));
  } catch (error) {
    say(document.getElementById("experiment"), error.message, true);
  }
}

async function show(token) {
  try {
    await post("api/session", { token });
    await enter();
  } catch (error) {
    knock();
    say(door, error.message, true);
  }
}

function knock() {
  for (const part of Object.keys(parts)) document.getElementById(part).hidden = true;
  door.hidden = false;
  document.getElementById("token").focus();
}

door.addEventListener("submit", (event) => { event.preventDefault(); show(document.getElementById("token").value); });

try {
  const { is_known: isKnown } = await post("api/session", {});
  const brought = new URLSearchParams(`token=${location.hash.slice(1)}`).get("token");
  if (isKnown) await enter();
  else if (brought && !isPart(place()[0])) {
    history.replaceState(null, "", location.pathname); // keeps the token out of the history
    await show(brought);
  } else knock();
} catch (error) {
  say(document.getElementById("experiment"), error.message, true);
}
