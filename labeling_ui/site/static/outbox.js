// Labels and undos on their way to the server: kept in the browser's storage until they are
// acknowledged, sent strictly in order, each with its own Idempotency-Key, so that a retry after a
// lost answer stores nothing twice.
//
// Entries belong to one annotator and are never sent under another's session.
//
// Events: "change" (detail: {waiting, offline, signedOut}), "sent" (detail: {entry, answer}),
//         "refused" (detail: {entry, error})

import { ApiError, OfflineError, newKey, request } from "./api.js";

const RETRY_MS = [1000, 2000, 4000, 8000, 15_000];

export class Outbox extends EventTarget {
  constructor(annotatorId, storage = window.localStorage) {
    super();
    this.storage = storage;
    this.prefix = `rodif-outbox-${annotatorId}-`;
    this.entries = this.read();
    this.labelIds = new Map(); // key of a label → its id on the server
    this.failures = 0;
    this.offline = false;
    this.signedOut = false;
    window.addEventListener("online", () => this.flush());
  }

  // One stored item an entry, so that two tabs never overwrite each other's.
  read() {
    const names = Object.keys(this.storage).filter((name) => name.startsWith(this.prefix));
    const entries = names.map((name) => JSON.parse(this.storage.getItem(name)));
    return entries.sort((one, other) => one.order - other.order);
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
    } catch (error) {
      // Storage is full or forbidden: the entry lives in this tab only, and says so.
      console.warn("labels cannot be kept in this browser:", error);
    }
  }

  tell() {
    const { offline, signedOut } = this;
    this.emit("change", { waiting: this.entries.length, offline, signedOut });
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

  // Sends until the box is empty or the server cannot be reached. Calls while it runs share it.
  flush() {
    this.running ??= this.sendAll().finally(() => {
      this.running = null;
    });
    return this.running;
  }

  async sendAll() {
    clearTimeout(this.timer);
    while (this.entries.length > 0) {
      const entry = this.entries[0];
      try {
        const answer = await this.send(entry);
        this.failures = 0;
        this.offline = this.signedOut = false;
        this.remove(entry);
        this.emit("sent", { entry, answer });
      } catch (error) {
        if (!this.mayDrop(entry, error)) return;
      }
    }
  }

  async send(entry) {
    const headers = { "Idempotency-Key": entry.key };
    if (entry.kind === "label") {
      const { data } = await request("POST", "/labels", { body: entry.body, headers });
      this.labelIds.set(entry.key, data.id);
      for (const other of this.entries) {
        if (other.kind === "undo" && other.labelKey === entry.key) {
          other.labelId = data.id;
          this.store(other);
        }
      }
      return data;
    }
    if (entry.labelId === undefined) throw new ApiError(404, { detail: "That label was not stored." });
    return (await request("POST", `/labels/${entry.labelId}/undo`, { body: {}, headers })).data;
  }

  // True when the server has refused the entry for good and the next one may go.
  mayDrop(entry, error) {
    const gone = error instanceof ApiError && error.status === 401;
    const later = error instanceof ApiError && (error.status === 429 || error.status >= 500);
    if (error instanceof OfflineError || gone || later) {
      this.offline = !gone;
      this.signedOut = gone;
      this.tell();
      if (!gone) {
        const wait = RETRY_MS[Math.min(this.failures, RETRY_MS.length - 1)];
        this.failures += 1;
        this.timer = setTimeout(() => this.flush(), wait);
      }
      return false;
    }
    this.remove(entry);
    this.emit("refused", { entry, error });
    return true;
  }

  remove(entry) {
    this.entries = this.entries.filter((other) => other.key !== entry.key);
    this.storage.removeItem(this.prefix + entry.key);
    this.tell();
  }
}
