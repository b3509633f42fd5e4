// Requests to the server, and functions that every part of the page uses.

import { Kept } from "./kept.js";

/** An element: el("td", {class: "best"}, "text", child, ...); texts stay texts. */
export function el(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") element.addEventListener(key, value);
    else if (value !== null && value !== false) element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

/** J_p as a J with a small p below. */
export function symbol(name) {
  const [, head, tail] = /^([^_]*)(?:_(.*))?$/.exec(name);
  return el("span", {}, head, tail ? el("sub", {}, tail) : null);
}

export const options = (select, entries, chosen) => select.replaceChildren(...entries.map((entry) =>
  Array.isArray(entry.group)
    ? el("optgroup", { label: entry.label }, ...entry.group.map((name) => el("option", { value: name, selected: name === chosen }, name)))
    : el("option", { value: entry, selected: entry === chosen }, entry)));

/** What is read out by a screen reader: a start, an end, a failure; once each. */
export function say(form, sentence, isBad = false) {
  const status = form.querySelector(".status");
  if (status.textContent !== sentence) status.textContent = sentence;
  status.classList.toggle("bad", isBad);
}

/** How far it is: shown, and not read out. */
export const tell = (form, sentence) => { form.querySelector(".progress").textContent = sentence; };

/** Says what is wrong with the first field of a form that has a value that is not allowed, also where it is folded away. */
export function tellInvalid(form) {
  form.addEventListener("invalid", ({ target }) => {
    if (target !== form.querySelector("input:invalid, select:invalid")) return;
    const { type, min, max, step, value, labels: [{ textContent: name }] } = target, kind = step === "1" ? "a whole number" : "a number";
    if (target.closest("details")) target.closest("details").open = true;
    const range = max ? `${kind} from ${min || 0} to ${max}` : `${kind}${min && ` of at least ${min}`}`;
    say(form, `${name.trim()}: ${type === "number" ? `${value ? `got ${value}` : "got no number"}, needed is ${range}.` : target.validationMessage}`, true);
  }, true);
}

async function sentenceOf(response) {
  try { return (await response.json()).sentence ?? "the server rejected the request"; }
  catch { return `the server answered with ${response.status}`; }
}

async function answered(address, request) {
  let response;
  try { response = await fetch(address, request); }
  catch { throw new Error("the server does not answer; is excite serve still running?"); }
  if (!response.ok) throw Object.assign(new Error(await sentenceOf(response)), { status: response.status });
  return response;
}

const json = (method, content) => ({
  method, headers: { "content-type": "application/json" }, body: JSON.stringify(content),
});

export const get = async (address) => (await answered(address)).json();
export const post = async (address, content) => (await answered(address, json("POST", content))).json();
export const remove = async (address) => (await answered(address, { method: "DELETE" })).json();
export const upload = async (address, file) => (await answered(address, { method: "POST", body: file })).json();

/** Posts what is wanted, if anything, and hands every line of the answer to `onEvent` as it comes. */
export async function stream(address, content, onEvent) {
  const reader = (await answered(address, content && json("POST", content))).body.pipeThrough(new TextDecoderStream()).getReader();
  for (let rest = ""; ;) {
    const { done, value } = await reader.read();
    if (done) return;
    const lines = value.split("\n");
    lines[0] = rest + lines[0];
    rest = lines.pop();
    lines.forEach((line) => onEvent(JSON.parse(line)));
  }
}

/** Something long behind the buttons of a form: one at a time, stopped by its stop button; it is found again by what is kept. */
export class Task {
  constructor(form, isReady = () => true) {
    Object.assign(this, { form, isReady, isBusy: false, job: null, kept: new Kept(form) });
    this.halt = form.querySelector(".stop");
    this.halt.addEventListener("click", () => this.stop());
    tellInvalid(form);
    this.refresh();
  }

  /** Which of the two buttons can be pressed now. */
  refresh() {
    this.form.querySelector(".primary").disabled = this.isBusy || !this.isReady();
    this.halt.disabled = !this.isBusy;
  }

  /** Returns what was said of a failure; null where there was none. */
  async run(address, content, onEvent) {
    if (this.isBusy) return null;
    this.isBusy = this.kept.isRunning = true;
    this.refresh();
    this.kept.save();
    let ending = "the connection ended too early; run it again", hasResult = false;
    try {
      await stream(address, content, (event) => {
        if (event.kind === "job") {
          this.job = event.job;
          this.kept.save({ shown: this.job });
          onEvent(event);
        } else if (event.kind === "end") ending = null;
        else if (event.kind === "stopped") { ending = null; say(this.form, "Stopped."); }
        else if (event.kind === "failed") {
          ending = event.sentence;
          if (!hasResult) this.kept.save({ shown: null });
        } else {
          hasResult ||= event.kind === "result" || event.kind === "identified";
          onEvent(event);
        }
      });
      if (ending) say(this.form, ending, true);
    } catch (error) {
      if (error.status === 404) this.kept.save({ shown: null });
      ending = error.message;
      say(this.form, ending, true);
    } finally {
      tell(this.form, "");
      this.job = null;
      this.isBusy = this.kept.isRunning = false;
      this.kept.save();
      this.refresh();
    }
    return ending;
  }

  async stop() {
    if (this.job === null) return;
    this.halt.disabled = true;
    say(this.form, "Stopping…");
    try { await remove(`api/jobs/${this.job}`); } catch { /* it ended by itself */ }
  }
}

/** A command for a terminal, and a button that copies it. */
export function command(text) {
  const said = el("span", { role: "status", class: "hint" });
  const copy = async () => {
    try { await navigator.clipboard.writeText(text); said.textContent = "Copied."; }
    catch { said.textContent = "The browser does not allow it: select the text."; }
  };
  return el("details", {}, el("summary", {}, "The same in a terminal"), el("pre", { tabindex: "0" }, text),
    el("p", { class: "row" }, el("button", { type: "button", click: copy }, "Copy"), said));
}

/** A link to a file; where there is none, the page says why instead of saving the answer. */
export function download(address, text) {
  const name = (new URLSearchParams(address.split("?")[1]).get("file") ?? address.split("?")[0]).split("/").at(-1);
  return el("a", { href: address, download: name, click: (event) => { event.preventDefault(); save(event.currentTarget); } }, text);
}

/** Saves what the page has made. */
export function keep(name, blob) {
  const file = URL.createObjectURL(blob);
  el("a", { href: file, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(file), 60_000);
}

async function save(link) {
  const section = link.closest("main > section");
  link.setAttribute("aria-busy", "true");
  try {
    keep(link.download, await (await answered(link.href)).blob());
  } catch (error) {
    say(section, error.message, true);
  } finally {
    link.removeAttribute("aria-busy");
  }
}
