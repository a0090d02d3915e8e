// The fleet as it is now: read once, then followed by server-sent events; kept, and marked stale, while the twin is away.

import * as api from "./api.js";

const SILENT_MS = 40000; // the twin sends a sign of life every 15 s
const RETRY_MS = [1000, 2000, 4000, 8000, 15000];
const HERE_MS = 20000; // between two signs of life to the worker that holds the stream for all tabs
const JOIN_MS = 10000; // within which that worker answers a page that joins
const SPREAD_MS = 10000; // within which all pages read the fleet anew, where very much changed at once

export class Live {
  constructor(changed, ended) {
    this.rows = new Map();
    this.changed = changed; // called with the names of the rows that changed; null: all
    this.ended = ended; // called where the session has ended
    this.state = "starting"; // starting, live, trouble, away, ended
    this.why = "";
    this.since = null; // s since the epoch: from then on what is shown may be out of date
    this.skew = 0;
    this.position = null;
    this.failures = 0;
    // A page that nobody sees follows nothing.
    document.addEventListener("visibilitychange", () => (document.hidden ? this.pause() : this.resume()));
    addEventListener("pagehide", () => this.pause());
    addEventListener("pageshow", (event) => event.persisted && this.resume());
  }

  now() {
    return Date.now() / 1000 + this.skew;
  }

  async start() {
    this.stop();
    try {
      const { rows, position, now } = await api.fleet();
      this.skew = now - Date.now() / 1000;
      this.rows = new Map(rows.map((row) => [row.servo, row]));
      this.position = position;
      this.follow();
      this.set("live");
      this.changed(null);
    } catch (error) {
      if (error.status === 401 || error.status === 403) return this.end(error.message);
      this.retry(error.message);
    }
  }

  pause() {
    if (this.state === "ended" || this.position === null) return;
    this.paused = true;
    this.stop();
  }

  resume() {
    if (!this.paused) return;
    this.paused = false;
    this.follow();
  }

  follow() {
    if (document.hidden) return this.pause();
    const source = globalThis.SharedWorker ? new SharedSource(this.position) : new EventSource(`/v1/fleet/events?after=${this.position}`);
    this.source = source;
    this.heard();
    for (const name of ["open", "rows", "alive", "trouble"]) source.addEventListener(name, () => this.heard());
    source.addEventListener("open", () => {
      this.failures = 0;
      this.set("live");
      this.changed([]);
    });
    source.addEventListener("rows", (event) => this.take(event));
    source.addEventListener("links", (event) => this.takeLinks(event));
    source.addEventListener("reload", () => {
      this.stop();
      this.timer = setTimeout(() => this.start(), Math.random() * SPREAD_MS);
    });
    source.addEventListener("trouble", (event) => this.trouble(read(event) || "The twin reports trouble."));
    source.addEventListener("ended", () => this.end("The session has ended, or its token was revoked."));
    source.addEventListener("error", () => this.lost());
    source.addEventListener("unloaded", () => this.retry("The twin cannot be reached."));
  }

  // A twin that hangs, and a network that is gone, end no connection.
  heard() {
    clearTimeout(this.silence);
    this.silence = setTimeout(() => this.retry("No message from the twin for 40 s."), SILENT_MS);
  }

  take(event) {
    const rows = read(event);
    if (!Array.isArray(rows)) return this.trouble("A message of the twin cannot be read.");
    this.position = event.lastEventId || this.position;
    for (const row of rows) if (row && typeof row.servo === "string") this.rows.set(row.servo, row);
    this.set("live");
    this.changed(rows.map((row) => row.servo));
  }

  takeLinks(event) {
    const links = read(event);
    if (!Array.isArray(links?.connected)) return;
    const connected = new Set(links.connected), names = [];
    for (const row of this.rows.values()) {
      const now = connected.has(row.servo) ? true : links.sole ? false : null;
      if (row.connected !== now) names.push(row.servo);
      row.connected = now;
    }
    if (names.length) this.changed(names);
  }

  trouble(why) {
    this.set("trouble", why);
    this.changed([]);
  }

  // The browser tries again by itself, unless the twin refused: then the reason is asked for.
  async lost() {
    this.set("away", "The twin cannot be reached.");
    this.changed([]);
    if (this.source.readyState !== EventSource.CLOSED) return;
    this.stop();
    try {
      const { admitted } = await api.session();
      if (!admitted) this.end("The session has ended, or its token was revoked.");
      else this.retry("Too many pages watch the fleet already.");
    } catch (error) {
      if (error.status === 401 || error.status === 403) this.end(error.message);
      else this.retry(error.message);
    }
  }

  retry(why) {
    this.stop();
    this.set("away", why);
    this.changed([]);
    const wait = RETRY_MS[Math.min(this.failures++, RETRY_MS.length - 1)];
    this.timer = setTimeout(() => this.start(), wait);
  }

  end(why) {
    this.stop();
    this.set("ended", why);
    this.ended(why);
  }

  stop() {
    clearTimeout(this.timer);
    clearTimeout(this.silence);
    this.source?.close();
  }

  set(state, why = "") {
    if (state === "live") this.since = null;
    else this.since ??= this.rows.size ? this.now() : null;
    this.state = state;
    this.why = why;
    document.documentElement.dataset.live = state;
  }
}

// The stream that all tabs of this browser share, with what this page uses of an EventSource.
class SharedSource extends EventTarget {
  constructor(position) {
    super();
    this.readyState = EventSource.CONNECTING;
    const worker = new SharedWorker("/static/stream_worker.js");
    const unloaded = () => this.port.onmessage && this.dispatchEvent(new Event("unloaded"));
    worker.onerror = unloaded;
    // Of a worker that could not be loaded nothing else is heard, and now and then not even that.
    this.joining = setTimeout(unloaded, JOIN_MS);
    this.port = worker.port;
    this.port.onmessage = ({ data: { type, data, lastEventId, readyState } }) => {
      clearTimeout(this.joining);
      this.readyState = readyState;
      this.dispatchEvent(Object.assign(new Event(type), { data, lastEventId }));
    };
    this.port.postMessage(position);
    this.timer = setInterval(() => this.port.postMessage("here"), HERE_MS);
  }

  close() {
    clearInterval(this.timer);
    clearTimeout(this.joining);
    this.port.onmessage = null;
    this.port.postMessage("leave");
    this.port.close();
  }
}

function read(event) {
  try {
    return JSON.parse(event.data);
  } catch {
    return null;
  }
}
