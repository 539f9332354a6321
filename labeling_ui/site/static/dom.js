// Small helpers to build and find elements.

export const find = (selector, root = document) => root.querySelector(selector);
export const findAll = (selector, root = document) => [...root.querySelectorAll(selector)];

// Controls of the templates come disabled, so that no click is lost before something listens to it.
export const enable = (...selectors) => {
  for (const selector of selectors) find(selector).disabled = false;
};

// element("div.card", {title: "x", onclick: f}, child, "text", …); null children are left out.
export function element(tag, attributes = {}, ...children) {
  const [name, ...classes] = tag.split(".");
  const made = document.createElement(name);
  if (classes.length > 0) made.className = classes.join(" ");
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "dataset") Object.assign(made.dataset, value);
    else made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return made;
}

const SVG = "http://www.w3.org/2000/svg";

export function svg(name, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children.flat().filter(Boolean));
  return made;
}

export function replace(target, ...children) {
  target.replaceChildren(...children.flat().filter((child) => child !== null && child !== undefined));
}

let toastTimer = null;

// A short note at the foot of the page, with at most one action.
export function toast(text, { action = null, onAction = null, bad = false, seconds = 6 } = {}) {
  let box = find("#toast");
  if (!box) {
    box = element("div.toast", { id: "toast", role: "status", "aria-live": "polite" });
    document.body.append(box);
  }
  clearTimeout(toastTimer);
  box.classList.toggle("bad", bad);
  const hide = () => {
    box.hidden = true;
  };
  const button = action
    ? element("button.link", { type: "button", onclick: () => { hide(); onAction(); } }, action)
    : null;
  replace(box, element("span", {}, text), button);
  box.hidden = false;
  toastTimer = setTimeout(hide, seconds * 1000);
}

// A question with optional fields. Resolves to an object of the fields' values, or null.
//   fields: [{name, label, kind: "text" | "number" | "password" | "select" | "textarea", value, options, hint, …}]
//     onChange: (value, form) => …, of a select
//   dismiss: the other button, where "Cancel" would say the same as the question
//   onSubmit: async (values) => …; an error it throws is shown in the dialog, which stays open
export function ask({ title, text = "", fields = [], confirm = "OK", dismiss = "Cancel", danger = false, onSubmit }) {
  return new Promise((resolve) => {
    const error = element("p.form-error", { role: "alert", hidden: true });
    const rows = fields.map(fieldRow);
    const submit = element(`button.button.${danger ? "danger" : "primary"}`, { type: "submit" }, confirm);
    const cancel = element("button.button", { type: "button", onclick: () => close(null) }, dismiss);
    const form = element(
      "form", {},
      element("h2", {}, title),
      text ? element("p.muted", {}, text) : null,
      ...rows, error,
      element("div.dialog-actions", {}, cancel, submit),
    );
    const dialog = element("dialog.dialog", { "aria-label": title }, form);
    const close = (value) => {
      dialog.close();
      dialog.remove();
      resolve(value);
    };
    dialog.addEventListener("cancel", (event) => {
      event.preventDefault();
      close(null);
    });
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      const values = readFields(form, fields);
      submit.disabled = true;
      error.hidden = true;
      try {
        await onSubmit?.(values);
        close(values);
      } catch (problem) {
        error.textContent = describe(problem);
        error.hidden = false;
        submit.disabled = false;
      }
    });
    document.body.append(dialog);
    dialog.showModal();
  });
}

// Something to read, until it is closed. The button takes it off the page at once, as it may be a
// secret: the browser tells of "close" only some time after the dialog has vanished.
export function show(title, ...content) {
  const form = element("form.dialog-actions", {}, element("button.button.primary", {}, "Close"));
  const dialog = element(
    "dialog.dialog.broad", { "aria-label": title }, element("h2", {}, title), ...content, form,
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    dialog.close(); // gives the focus back
    dialog.remove();
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}

function fieldRow(field) {
  const id = `field-${field.name}`;
  const shared = { id, name: field.name, "aria-describedby": field.hint ? `${id}-hint` : null };
  let input;
  if (field.kind === "select") {
    const options = field.options.map(([value, label]) =>
      element("option", { value, selected: value === field.value }, label));
    const onchange = (event) => field.onChange?.(event.target.value, event.target.form);
    input = element("select.input", { ...shared, onchange }, ...options);
  } else if (field.kind === "textarea") {
    input = element("textarea.input", { ...shared, rows: 3, required: field.required }, field.value ?? "");
  } else {
    const { min, max, step, placeholder, required, autocomplete } = field;
    const type = field.kind ?? "text";
    const rules = { type, min, max, step, placeholder, required, autocomplete };
    input = element("input.input", { ...shared, ...rules, value: field.value ?? "" });
  }
  const hint = field.hint ? element("small.muted", { id: `${id}-hint` }, field.hint) : null;
  return element("div.field", {}, element("label", { for: id }, field.label), input, hint);
}

function readFields(form, fields) {
  const values = {};
  for (const { name, kind } of fields) {
    const { value } = form.elements[name];
    const text = kind === "password" ? value : value.trim(); // to sign in, it is typed as it was set
    if (kind === "number") values[name] = text === "" ? null : Number(text);
    else values[name] = text;
  }
  return values;
}

// An error as a sentence, with the fields that the server named.
export function describe(error) {
  const details = error.problem?.errors;
  if (!Array.isArray(details) || details.length === 0) return error.message;
  const lines = details.map((item) => {
    if (typeof item === "string") return item;
    const where = item.field ?? (Array.isArray(item.loc) ? item.loc.slice(1).join(".") : item.loc) ?? "";
    return `${where ? `${where}: ` : ""}${item.message ?? item.msg ?? JSON.stringify(item)}`;
  });
  return lines.join(" · ");
}
