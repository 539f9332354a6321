import { ApiError, request } from "./api.js";
import { describe, find } from "./dom.js";

const form = find("#sign-in-form");
const message = find("#sign-in-error");
const button = find("button", form);

// Only addresses of this site: a link must not be able to send people elsewhere after they sign in.
function nextPage(role) {
  const asked = new URLSearchParams(location.search).get("next");
  if (asked) {
    const address = new URL(asked, location.origin);
    if (address.origin === location.origin && asked.startsWith("/")) {
      return address.pathname + address.search;
    }
  }
  return role === "annotator" ? "/label" : "/admin";
}

function complain(text) {
  message.textContent = text;
  message.hidden = false;
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const name = form.elements.name.value.trim();
  const password = form.elements.password.value;
  if (!name || !password) return complain("Enter your name and your password.");
  button.disabled = true;
  message.hidden = true;
  try {
    const { data } = await request("POST", "/session", { body: { name, password } });
    location.assign(nextPage(data.annotator.role));
  } catch (error) {
    const wrong = error instanceof ApiError && error.status === 401;
    complain(wrong ? "Name or password is wrong." : describe(error));
    form.elements.password.select();
  } finally {
    button.disabled = false;
  }
});

button.disabled = false; // before, the browser would have sent the form itself
