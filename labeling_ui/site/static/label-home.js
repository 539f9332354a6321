import { ApiError, getAll, signInAddress } from "./api.js";
import { describe, element, find, replace } from "./dom.js";
import { Outbox } from "./outbox.js";
import { showOutbox } from "./outbox-notes.js";

const outbox = new Outbox(document.body.dataset.meId);
showOutbox(outbox);
outbox.flush(); // what waits since the last visit

const box = find("#campaigns");

try {
  const campaigns = (await getAll("/campaigns")).filter((campaign) => !campaign.archived);
  if (campaigns.length === 1) location.replace(`/label/${campaigns[0].id}`);
  const links = campaigns.map((campaign) =>
    element(
      "a.card.campaign-link", { href: `/label/${campaign.id}` },
      element("h2", {}, campaign.name), element("span.muted", {}, campaign.criterion),
    ));
  const nothing = element(
    "div.card.empty", {},
    element("strong", {}, "Nothing to label yet"), "There is no campaign. Come back later.",
  );
  replace(box, links.length > 0 ? links : nothing);
} catch (error) {
  if (error instanceof ApiError && error.status === 401) location.assign(signInAddress());
  replace(box, element("p.form-error", { role: "alert" }, describe(error)));
}
