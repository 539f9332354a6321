// What an outbox says on a page: what waits and why, what this browser cannot keep, and what the
// server did not accept.

import { signInAddress } from "./api.js";
import { element, find, replace, show } from "./dom.js";
import { CHOICES, ago } from "./format.js";

const answers = (count, one, many) => (count === 1 ? `1 answer ${one}` : `${count} answers ${many}`);
const button = (text, onclick) => element("button.link", { type: "button", onclick }, text);

// Needs the page's #outbox-waiting and #outbox-refused.
export function showOutbox(outbox) {
  outbox.addEventListener("change", ({ detail }) => {
    tellWaiting(find("#outbox-waiting"), detail);
    tellRefused(find("#outbox-refused"), outbox);
  });
  window.addEventListener("beforeunload", (event) => {
    if (outbox.unkept.size > 0) event.preventDefault(); // the browser asks whether to leave
  });
  outbox.tell();
}

const REASON = { offline: "No connection.", busy: "The server cannot take answers now.", signedOut: "You are signed out." };

function tellWaiting(banner, { waiting, unkept, trouble }) {
  banner.hidden = !(waiting > 0 && (trouble || unkept > 0));
  if (banner.hidden) return;
  const kept = unkept > 0
    ? `${answers(waiting, "waits", "wait")} in this tab only, because this browser’s storage is full or switched off: leave it open.`
    : `${answers(waiting, "is", "are")} kept on this device.`;
  const then = trouble === "signedOut"
    ? ["Sent after you ", element("a", { href: signInAddress() }, "sign in"), " again."]
    : ["Sent as soon as the server takes answers."];
  const why = trouble ? `${REASON[trouble]} ` : "";
  replace(banner, element("span", {}, `${why}${kept} `, ...then));
}

function tellRefused(banner, outbox) {
  const count = outbox.refused.length;
  banner.hidden = count === 0;
  if (banner.hidden || banner.dataset.count === String(count)) return; // a click is perhaps on its way
  banner.dataset.count = count;
  replace(
    banner, element("span", {}, `${answers(count, "was", "were")} not accepted.`),
    button("Show", () => showRefused(outbox)),
  );
}

function showRefused(outbox) {
  const rows = outbox.refused.map((entry) => {
    const what = entry.kind === "undo" ? "Undo" : `${CHOICES[entry.body.choice]}, pair ${entry.body.pair_id}`;
    const when = ago(new Date(entry.order).toISOString());
    return element("li", {}, element("strong", {}, what), ` · ${when}`, element("br"), entry.refused);
  });
  const closing = (action) => (event) => {
    event.target.closest("dialog").close();
    action();
  };
  show(
    "Not accepted",
    element("p.muted", {}, "The server did not store these answers. They stay on this device until you decide."),
    element("ul.refused-list", {}, rows),
    element(
      "div.dialog-actions", {},
      element("button.button", { type: "button", onclick: closing(() => outbox.discardRefused()) }, "Discard"),
      element("button.button", { type: "button", onclick: closing(() => outbox.resend()) }, "Send again"),
    ),
  );
}
