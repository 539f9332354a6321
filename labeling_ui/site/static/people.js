// The accounts of the studio: who may label, who may administer; new accounts and passwords.

import { getAll, post, request } from "./api.js";
import { ask, describe, element, enable, find, replace, toast } from "./dom.js";
import { count } from "./format.js";
import { table } from "./panels.js";
import { addToken, drawTokens } from "./tokens.js";

const ROLES = [["annotator", "Annotator: labels"], ["admin", "Admin: everything"], ["service", "Service: scripts"]];
const PASSWORD_HINT = "At least 8 characters. Tell it to the person yourself.";

export async function drawPeople() {
  const people = await getAll("/annotators");
  const heads = [["Name"], ["Role"], ["Labels", "number"], [""]];
  replace(find("#people"), table(heads, people.map(row), "Nobody."));
  find("#new-token").onclick = () => addToken(people);
  enable("#new-token");
  await drawTokens(people);
}

function row(person) {
  const name = `person-${person.id}`; // says whose buttons these are, to who does not see the row
  const change = (text, action) =>
    element("button.button.small", { type: "button", "aria-describedby": name, onclick: action }, text);
  return element(
    "tr", { dataset: { person: person.id } },
    element("td", { id: name }, person.name, person.active ? null : element("span.under", {}, "deactivated")),
    element("td", {}, person.role, person.kind === "simulated" ? element("span.under", {}, "simulated") : null),
    element("td.number", {}, count(person.labels)),
    element(
      "td.tight", {}, change("Password", () => setPassword(person)), " ",
      person.active ? change("Deactivate", () => deactivate(person)) : change("Activate", () => activate(person)),
    ),
  );
}

// After a dialog: what has changed is stored already, so not being able to show it loses nothing.
async function redraw() {
  try {
    await drawPeople();
  } catch (error) {
    toast(describe(error), { bad: true, seconds: 12 });
  }
}

const patch = (person, body) => request("PATCH", `/annotators/${person.id}`, { body });

export async function addPerson() {
  const made = await ask({
    title: "New account",
    confirm: "Create",
    fields: [
      { name: "name", label: "Name", required: true },
      { name: "role", label: "Role", kind: "select", options: ROLES },
      { name: "password", label: "Password", kind: "password", required: true, hint: PASSWORD_HINT },
    ],
    onSubmit: (values) => post("/annotators", values),
  });
  if (made) toast(`${made.name} can sign in now.`);
  await redraw();
}

async function setPassword(person) {
  const done = await ask({
    title: `New password for ${person.name}`,
    text: "Signs this person out everywhere and revokes all tokens of the account.",
    confirm: "Set password",
    fields: [{ name: "password", label: "Password", kind: "password", required: true, hint: PASSWORD_HINT }],
    onSubmit: ({ password }) => patch(person, { password }),
  });
  if (done) toast("The password is changed.");
  await redraw();
}

async function deactivate(person) {
  await ask({
    title: `Deactivate ${person.name}?`,
    text: "This person is signed out and cannot come back until activated again. Tokens are revoked for good; all labels stay.",
    confirm: "Deactivate",
    danger: true,
    onSubmit: () => patch(person, { active: false }),
  });
  await redraw();
}

async function activate(person) {
  try {
    await patch(person, { active: true });
    toast(`${person.name} can sign in again.`);
    await redraw();
  } catch (error) {
    toast(describe(error), { bad: true, seconds: 12 });
  }
}
