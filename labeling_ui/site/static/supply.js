// Which pair comes next: asks the server, has one more ready, and gives back what cannot be judged.

import { ApiError, OfflineError, request } from "./api.js";

// An item is {handout, player | null, …}; `prepare(handout, active)` makes one.
export class Supply {
  constructor(campaignId, outbox, prepare) {
    this.campaignId = campaignId;
    this.outbox = outbox;
    this.prepare = prepare;
    this.waiting = []; // in the order in which they come
  }

  // What waits, or null.
  take() {
    this.dropExpired();
    return this.waiting.shift() ?? null;
  }

  putFirst(item) {
    this.waiting.unshift(item);
  }

  // A pair whose lease has run out while it waited may be somebody else's by now.
  dropExpired() {
    const now = Date.now();
    const expired = (item) => !item.reopened && new Date(item.handout.expires_at).getTime() < now;
    this.waiting.filter(expired).forEach((item) => item.player?.close());
    this.waiting = this.waiting.filter((item) => !expired(item));
  }

  // {item} or {reason}. A label on its way would make the server offer its pair again, which would
  // be judged twice: first it must be stored.
  async next() {
    await this.outbox.settle();
    const { handout, reason } = await this.ask({ hold: 1 });
    return handout ? { item: this.prepare(handout, true) } : { reason };
  }

  // Has the pair after `item` ready, as long as `isShown()`.
  async lookAhead(item, isShown) {
    if (this.waiting.length > 0) return;
    try {
      await this.outbox.settle();
      if (!isShown() || this.waiting.length > 0) return;
      const { handout } = await this.ask({ hold: 2, prefetch_after_pair_id: item.handout.pair.id });
      if (!handout || !isShown() || this.waiting.length > 0) return;
      if (handout.pair.id !== item.handout.pair.id) this.waiting.push(this.prepare(handout, false));
    } catch (error) {
      // Not being able to look ahead hurts nobody; the next step reports what is wrong.
      if (!(error instanceof OfflineError) && !(error instanceof ApiError)) throw error;
    }
  }

  // Gives the pair back, with the reason for the admins.
  async release(item, reason) {
    await this.outbox.flush(); // an undo on its way brings another lease
    try {
      await request("POST", `/leases/${item.handout.lease_id}/release`, { body: { reason } });
    } catch (error) {
      // Judged in another tab: there is nothing to give back.
      if (!(error instanceof ApiError) || error.status !== 409) throw error;
    }
  }

  async ask(body) {
    const answer = await request("POST", `/campaigns/${this.campaignId}/next`, { body });
    if (answer.status === 204) return { reason: answer.headers.get("X-Reason") ?? "no_pairs" };
    return { handout: answer.data };
  }
}
