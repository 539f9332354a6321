import { request } from "./api.js";
import { ask, describe, enable, find, toast } from "./dom.js";

find("#own-password").addEventListener("click", async () => {
  menu.open = false;
  const hint = "At least 8 characters.";
  const done = await ask({
    title: "Change password",
    text: "Signs you out everywhere else and revokes all tokens of your account.",
    confirm: "Change password",
    fields: [
      { name: "current", label: "Current password", kind: "password", required: true, autocomplete: "current-password" },
      { name: "password", label: "New password", kind: "password", required: true, hint, autocomplete: "new-password" },
      { name: "again", label: "New password again", kind: "password", required: true, autocomplete: "new-password" },
    ],
    onSubmit: async ({ current, password, again }) => {
      if (password !== again) throw new Error("The two new passwords are not the same.");
      await request("PUT", "/me/password", { body: { current, password } });
    },
  });
  if (done) toast("Your password is changed.");
});

find("#sign-out").addEventListener("click", async () => {
  try {
    await request("DELETE", "/session");
    location.assign("/sign-in");
  } catch (error) {
    if (error.status === 401) location.assign("/sign-in");
    else toast(describe(error), { bad: true });
  }
});

const menu = find(".menu");
document.addEventListener("click", (event) => {
  if (!menu.contains(event.target)) menu.open = false;
});
document.addEventListener("keydown", (event) => {
  if (event.key !== "Escape" || !menu.open) return;
  if (menu.contains(document.activeElement)) find("summary", menu).focus(); // what it was on is gone
  menu.open = false;
});
enable("#own-password", "#sign-out");
