// What comes back when the page is loaded again: the fields of a form, and the names of what its view shows.

const fieldsOf = (form) => [...form.elements].filter((field) => field.id && field.matches("select, input:not([type=file])"));
const content = (field) => (field.type === "checkbox" ? "checked" : "value");

export class Kept {
  /** What was kept for this form in this tab, or else in the tab that was used last. */
  constructor(form) {
    Object.assign(this, { form, name: form.parentElement.id, more: form.querySelector("details"), isFilling: false });
    const before = sessionStorage.getItem(this.name) ?? localStorage.getItem(this.name);
    this.state = { fields: {}, isOpen: false, shown: null, upload: null, ...JSON.parse(before) };
    ["input", "change", "click"].forEach((kind) => form.addEventListener(kind, () => this.save()));
    this.more.addEventListener("toggle", () => this.save());
  }

  /** Keeps the form as it is now, and more of the state. What a form lacks for now, such as columns, stays. */
  save(more = {}) {
    if (this.isFilling) return;
    for (const field of fieldsOf(this.form)) this.state.fields[field.id] = field[content(field)];
    const text = JSON.stringify(Object.assign(this.state, { isOpen: this.more.open }, more));
    [sessionStorage, localStorage].forEach((store) => store.setItem(this.name, text));
  }

  /** Fills the form in its order, as a person does; returns a sentence where its plant is not there. */
  fill() {
    let gone = "";
    this.isFilling = true;
    this.more.open = this.state.isOpen;
    for (const [id, before] of Object.entries(this.state.fields)) {
      const field = document.getElementById(id), is = field && content(field);
      if (!field || field[is] === before) continue;
      if (field.options && ![...field.options].some(({ value }) => value === before)) {
        if (!id.endsWith("plant")) continue;
        gone = `the plant ${before} is no longer on the server`;
        break; // the other fields are of this plant
      }
      field[is] = before;
      ["input", "change"].forEach((kind) => field.dispatchEvent(new Event(kind, { bubbles: true })));
    }
    this.isFilling = false;
    return gone;
  }
}
