// What comes back when the page is loaded again: the fields of a form, and the names of what its view shows.

const fieldsOf = (form) => [...form.elements].filter((field) => field.id && field.matches("select, input:not([type=file])"));
const content = (field) => (field.type === "checkbox" ? "checked" : "value");

const kind = (value) => Object.prototype.toString.call(value);

/**
 * What was kept under a name in this tab, over `usual`; what this page cannot have written is left out.
 * A new tab begins with what the tab that was used last has kept, and then has its own.
 */
export function recall(name, usual) {
  const state = { ...usual };
  try {
    const before = JSON.parse(sessionStorage.getItem(name) ?? localStorage.getItem(name)) ?? {};
    for (const key of Object.keys(usual)) if (key in before && (usual[key] === null || kind(before[key]) === kind(usual[key]))) state[key] = before[key];
  } catch { /* damaged, or the browser allows none */ }
  store("sessionStorage", name, state);
  return state;
}

/** Keeps a state in one of the browser's storages. */
export function store(storage, name, state) {
  try { window[storage].setItem(name, JSON.stringify(state)); } catch { /* there is no room, or the browser allows none */ }
}

export class Kept {
  /** What was kept for this form in this tab, or else in the tab that was used last; where a plant is gone, fields that are of it stay as they are. */
  constructor(form, areOfPlant = true) {
    Object.assign(this, { form, areOfPlant, name: `excite-${form.parentElement.id}`, details: form.querySelector("details"), isFilling: false, isRunning: false });
    this.state = recall(this.name, { fields: {}, isOpen: false, shown: null, upload: null, mapped: null, results: [] });
    ["input", "change", "click"].forEach((kind) => form.addEventListener(kind, () => this.save()));
    this.details?.addEventListener("toggle", () => { if (this.details.open !== this.state.isOpen) this.save(); }); // not when it is filled
  }

  /** Keeps the form as it is now, and more of the state. What a form lacks for now, such as columns, stays; a new tab does not take over what runs. */
  save(more = {}) {
    if (this.isFilling) return;
    for (const field of fieldsOf(this.form)) {
      if (field.value === field.dataset.usual) delete this.state.fields[field.id];
      else this.state.fields[field.id] = field[content(field)];
    }
    Object.assign(this.state, { isOpen: Boolean(this.details?.open) }, more);
    store("sessionStorage", this.name, this.state);
    store("localStorage", this.name, { ...this.state, shown: this.isRunning ? null : this.state.shown });
  }

  /** Fills the form in its order, as a person does; returns a sentence where its plant is not there. */
  fill() {
    let gone = "";
    this.isFilling = true;
    if (this.details) this.details.open = this.state.isOpen;
    for (const [id, before] of Object.entries(this.state.fields)) {
      const field = document.getElementById(id), is = field && content(field);
      if (!field || field[is] === before) continue;
      if (field.options && ![...field.options].some(({ value }) => value === before)) {
        if (!id.endsWith("plant")) continue;
        gone = `the plant ${before} is no longer on the server`;
        if (this.areOfPlant) break;
        continue;
      }
      field[is] = before;
      ["input", "change"].forEach((kind) => field.dispatchEvent(new Event(kind, { bubbles: true })));
    }
    this.isFilling = false;
    return gone;
  }
}
