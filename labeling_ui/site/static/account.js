import { request } from "./api.js";
import { describe, enable, find, toast } from "./dom.js";

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
enable("#sign-out");
