// Tokens for scripts: made for an account, shown once, listed without the secret, revoked.

import { getAll, post, request } from "./api.js";
import { ask, describe, element, find, replace, show, toast } from "./dom.js";
import { ago, day } from "./format.js";
import { table } from "./panels.js";

// `people` are all accounts, to name the owner of each token.
export async function drawTokens(people) {
  const now = Date.now();
  const tokens = (await getAll("/tokens")).filter((token) => !token.revoked_at && new Date(token.expires_at).getTime() > now);
  const nameOf = new Map(people.map((person) => [person.id, person.name]));
  const heads = [["Token"], ["Account"], ["Last used"], ["Valid until"], [""]];
  const rows = tokens.map((token) => row(token, nameOf.get(token.annotator_id), people));
  replace(find("#tokens"), table(heads, rows, "None. Scripts and the rodif commands sign in with a token."));
}

async function redraw(people) {
  try {
    await drawTokens(people);
  } catch (error) {
    toast(describe(error), { bad: true, seconds: 12 });
  }
}

function row(token, owner, people) {
  const name = `token-${token.id}`;
  return element(
    "tr", { dataset: { token: token.id } },
    element("td", { id: name }, token.name),
    element("td", {}, owner),
    element("td", {}, token.last_used_at ? ago(token.last_used_at) : "never"),
    element("td", {}, day(token.expires_at)),
    element("td.tight", {}, element("button.button.small", { type: "button", "aria-describedby": name, onclick: () => revoke(token, owner, people) }, "Revoke")),
  );
}

export async function addToken(people) {
  const made = {};
  const owners = people.filter((person) => person.active && person.kind === "person");
  const me = Number(document.body.dataset.meId);
  const values = await ask({
    title: "New token",
    text: "A script that carries it acts as the account.",
    confirm: "Make token",
    fields: [
      { name: "name", label: "What it is for", required: true, placeholder: "simulate" },
      { name: "owner", label: "Account", kind: "select", value: me, options: owners.map((person) => [person.id, person.name]) },
      { name: "days", label: "Valid for, in days", kind: "number", value: 90, min: 1, max: 3650, step: 1, required: true },
    ],
    onSubmit: async ({ name, owner, days }) => {
      made.token = (await post("/tokens", { name, annotator_id: Number(owner), days })).token;
    },
  });
  if (!values) return;
  show(
    `Token “${values.name}”`,
    element("p.muted", {}, "Copy it now: it is not shown again."),
    element("p", {}, element("code.secret", {}, made.token)),
  );
  await redraw(people);
}

async function revoke(token, owner, people) {
  const done = await ask({
    title: `Revoke “${token.name}” of ${owner}?`,
    text: "Scripts that use it are refused from now on.",
    confirm: "Revoke",
    danger: true,
    onSubmit: () => request("DELETE", `/tokens/${token.id}`),
  });
  if (done) toast("The token is revoked.");
  await redraw(people);
}
