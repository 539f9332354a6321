// Labels and undos on their way to the server: kept in the browser's storage until the server has
// said that they are stored, sent strictly in order, each with its own Idempotency-Key, so that a
// retry after a lost answer stores nothing twice.
//
// Entries belong to one annotator, whose id goes with each of them: under another session the
// server refuses them, and they wait. What the server refuses for good is kept, too, with the
// reason, until the annotator sends it again or discards it. Everything else is tried again.
//
// Events: "change" (detail: {waiting, refused, unkept, trouble}), "sent" (detail: {entry, answer})

import { ApiError, OfflineError, kindOf, newKey, request } from "./api.js";

const RETRY_MS = [1000, 2000, 4000, 8000, 15_000];

function deviceStorage() {
  try {
    return window.localStorage;
  } catch {
    return null; // forbidden in this browser
  }
}

export class Outbox extends EventTarget {
  constructor(annotatorId, storage = deviceStorage()) {
    super();
    this.annotatorId = annotatorId;
    this.storage = storage;
    this.prefix = `rodif-outbox-${annotatorId}-`;
    const stored = this.read();
    this.entries = stored.filter((entry) => !entry.refused);
    this.refused = stored.filter((entry) => entry.refused); // {…, refused: the reason as a sentence}
    this.unkept = new Set(); // keys of what lives in this tab only
    this.labelIds = new Map(); // key of a label → its id on the server
    this.failures = 0;
    this.trouble = null; // the error that holds the first entry up
    window.addEventListener("online", () => this.flush());
    document.addEventListener("visibilitychange", () => {
      if (document.visibilityState === "visible") this.flush(); // perhaps signed in in another tab
    });
  }

  // One stored item an entry, so that two tabs never overwrite each other's.
  read() {
    const names = Object.keys(this.storage ?? {}).filter((name) => name.startsWith(this.prefix));
    return inOrder(names.map((name) => JSON.parse(this.storage.getItem(name))));
  }

  add(entry) {
    const last = this.entries.at(-1)?.order ?? 0;
    entry.order = Math.max(Date.now(), last + 1);
    this.entries.push(entry);
    this.store(entry);
    this.flush();
    this.tell();
  }

  store(entry) {
    try {
      this.storage.setItem(this.prefix + entry.key, JSON.stringify(entry));
      this.unkept.delete(entry.key);
    } catch {
      this.unkept.add(entry.key); // storage is full or forbidden; the page says so
    }
  }

  tell() {
    const trouble = this.trouble && kindOf(this.trouble);
    const [waiting, refused, unkept] = [this.entries.length, this.refused.length, this.unkept.size];
    this.emit("change", { waiting, refused, unkept, trouble });
  }

  emit(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  // Returns the label's key; `undo` takes it.
  label(body) {
    const key = newKey();
    this.add({ kind: "label", key, body });
    return key;
  }

  undo(labelKey) {
    this.add({ kind: "undo", key: newKey(), labelKey, labelId: this.labelIds.get(labelKey) });
  }

  // Sends until the box is empty or something is in the way. Calls while it runs share it.
  flush() {
    this.running ??= this.sendAll().finally(() => {
      this.running = null;
    });
    return this.running;
  }

  // Resolves when nothing waits any more; throws what is in the way.
  async settle() {
    while (this.entries.length > 0) {
      await this.flush();
      if (this.trouble) throw this.trouble;
    }
  }

  async sendAll() {
    clearTimeout(this.timer);
    while (this.entries.length > 0) {
      const entry = this.entries[0];
      try {
        const answer = await this.send(entry);
        this.failures = 0;
        this.trouble = null;
        this.remove(entry);
        this.emit("sent", { entry, answer });
      } catch (error) {
        if (kindOf(error) !== "final") return this.wait(error);
        this.refuse(entry, error);
      }
    }
  }

  async send(entry) {
    const headers = { "Idempotency-Key": entry.key, "X-Annotator-Id": this.annotatorId };
    if (entry.kind === "undo") {
      if (entry.labelId === undefined) throw new ApiError(404, { detail: "The answer that it takes back was not stored." });
      const { data } = await request("POST", `/labels/${entry.labelId}/undo`, { body: {}, headers });
      return acknowledged(data, data.label?.id);
    }
    const { data } = await request("POST", "/labels", { body: entry.body, headers });
    acknowledged(data, data.id);
    this.labelIds.set(entry.key, data.id);
    for (const other of this.entries) {
      if (other.kind === "undo" && other.labelKey === entry.key) {
        other.labelId = data.id;
        this.store(other);
      }
    }
    return data;
  }

  wait(error) {
    this.trouble = error;
    if (kindOf(error) !== "signedOut") {
      const pause = RETRY_MS[Math.min(this.failures, RETRY_MS.length - 1)];
      this.failures += 1;
      this.timer = setTimeout(() => this.flush(), pause);
    }
    this.tell();
  }

  // The server does not want it: out of the way of the next ones, but not away.
  refuse(entry, error) {
    this.trouble = null;
    entry.refused = error.message;
    this.entries = this.entries.filter((other) => other.key !== entry.key);
    this.refused.push(entry);
    this.store(entry);
    this.tell();
  }

  resend() {
    for (const entry of this.refused) {
      delete entry.refused;
      this.store(entry);
    }
    this.entries = inOrder([...this.entries, ...this.refused]);
    this.refused = [];
    this.tell();
    return this.flush();
  }

  discardRefused() {
    this.refused.forEach((entry) => this.forget(entry));
    this.refused = [];
    this.tell();
  }

  remove(entry) {
    this.entries = this.entries.filter((other) => other.key !== entry.key);
    this.forget(entry);
    this.tell();
  }

  forget(entry) {
    this.storage?.removeItem(this.prefix + entry.key);
    this.unkept.delete(entry.key);
  }
}

const inOrder = (entries) => entries.sort((one, other) => one.order - other.order);

// Only a row's id says that the server has stored something.
function acknowledged(data, id) {
  if (!Number.isInteger(id)) throw new OfflineError();
  return data;
}
