// Live: the least and greatest position, error and command of each 100 ms, while somebody looks and the edge allows it.

import * as api from "./api.js";
import { legend, TimePlot } from "./charts.js";
import { element, setText } from "./dom.js";
import { commandUnit, positionUnit } from "./format.js";

const ASK_MS = 500, IDLE_MS = 3000, SHOWN_S = 30;
const WORDS = {
  off: ["Off at the edge", "Set live = true in the table [twin] of the edge's file. Edges of earlier versions have no live view."],
  away: ["The edge is not connected", "The live view begins when the edge connects."],
  waiting: ["Waiting", "The edge has been asked; nothing has come yet."],
  live: ["Live", "The edge sends the newest samples while somebody looks at this page."],
  stale: ["Stale", "No new data for a while: the curves are old."],
  failed: ["Unknown", ""],
  asking: ["Waiting", "The twin is being asked."],
};

export class LiveViewPanel {
  // machine () => the facts of the machine's model, or null
  constructor(name, machine) {
    Object.assign(this, { name, machine, boot: 0, newest: -1, width: 0.1, columns: [] });
    this.word = element("strong", { class: "mark none", "aria-live": "polite" });
    this.note = element("span", { class: "soft" });
    const places = [element("div", { class: "chart low" }), element("div", { class: "chart low" }), element("div", { class: "chart low" })];
    const band = { series: [{ label: "greatest", color: "blue", width: 1 }, { label: "least", color: "blue", width: 1 }], bands: [[1, 2, "blue"]] };
    this.plots = places.map((place) => new TimePlot(place, { sync: "live", moving: true, xLabel: "Time to the newest sample (s)", ...band }));
    this.body = element("div", { hidden: true }, legend(["blue band", "least to greatest sample of each 100 ms"]), element("div", { class: "three" }, places));
    this.content = [element("p", { class: "live" }, this.word, " ", this.note), this.body];
    this.seen = () => this.schedule(0);
    document.addEventListener("visibilitychange", this.seen);
    this.say("asking");
    this.answered = new Promise((resolve) => { this.hasAnswered = resolve; });
    this.schedule(0);
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    document.removeEventListener("visibilitychange", this.seen);
  }

  // A page that nobody sees asks for nothing, so that the edge stops.
  schedule(wait) {
    clearTimeout(this.timer);
    if (!this.closed && !document.hidden) this.timer = setTimeout(() => this.ask(), wait);
  }

  async ask() {
    if (this.asking) return;
    this.asking = true;
    let wait = IDLE_MS;
    try {
      const found = await api.live(this.name, this.boot, Math.max(0, this.newest));
      if (!WORDS[found?.state] || !Array.isArray(found.columns)) throw new Error("The twin's answer cannot be read.");
      this.say(found.state, found.state === "stale" ? `The newest sample is ${Math.round(found.age)} s old.` : null);
      if (found.state === "live" || found.state === "waiting" || found.state === "stale") wait = ASK_MS;
      if (found.columns.length) this.take(found);
    } catch (error) {
      this.say("failed", error.message);
    }
    this.asking = false;
    this.hasAnswered();
    this.schedule(wait);
  }

  say(state, note = null) {
    setText(this.word, WORDS[state][0]);
    setText(this.note, note ?? WORDS[state][1]);
    this.word.className = `mark ${{ live: "good", stale: "bad", failed: "bad" }[state] ?? "none"}`;
    // Once there it stays, so that nothing below moves when an edge comes and goes.
    this.body.hidden &&= ["asking", "off"].includes(state);
    this.body.classList.toggle("stale", state !== "live" && this.columns.length > 0);
    if (!this.body.hidden && !this.columns.length) this.show(); // the place of what will come
  }

  take(found) {
    if (found.boot !== this.boot || found.first !== this.newest + 1) this.columns = [];
    this.columns.push(...found.columns);
    Object.assign(this, { boot: found.boot, newest: found.first + found.columns.length - 1, width: found.width });
    this.columns.splice(0, Math.max(0, this.columns.length - Math.round(SHOWN_S / this.width)));
    this.show();
  }

  show() {
    const shown = Math.round(SHOWN_S / this.width);
    const machine = this.machine(), unit = positionUnit(machine);
    const time = Array.from({ length: shown }, (_, i) => (i - shown + 1) * this.width);
    const missing = new Array(shown - this.columns.length).fill(null);
    const names = [["Position", unit.name, unit.factor], ["Error", unit.name, unit.factor], ["Command", commandUnit(machine), 1]];
    names.forEach(([name, dimension, factor], k) => {
      const values = (which) => [...missing, ...this.columns.map((column) => (column[which] === null ? null : column[which] * factor))];
      this.plots[k].options.yLabel = `${name} (${dimension})`;
      this.plots[k].show([time, values(2 * k + 1), values(2 * k)], `${name} of the last ${SHOWN_S} s in ${dimension}, live`);
    });
  }
}
