/* global uPlot */
// One machine: what is known, its gap over time, its last windows, the updates and what they were verified on.

import * as api from "./api.js";
import { ActsPanel } from "./acts.js";
import { legend, loopPlot, TimePlot } from "./charts.js";
import { element, fill, setText } from "./dom.js";
import { ago, brief, commandUnit, DEG, duration, gapText, limitInterval, limitText, linkOf, positionUnit, rateText, rateUnit, rowGapText, smallUnit, stamp, statusText, travelText } from "./format.js";
import { LiveViewPanel } from "./live_view.js";
import { ResidualPanel } from "./residual.js";
import { chainTable, eventList, FELL_BACK, settingInForce, simulated } from "./updates.js";
import { WhatIfPanel } from "./what_if.js";

const REFRESH_MS = 1500, EVERY = 20000, PART = 4 * EVERY; // samples that one answer holds undecimated
const scaled = (values, factor) => values.map((value) => (value === null ? null : value * factor));

export class MachinePage {
  constructor(view, live, name) {
    Object.assign(this, { view, live, name, gaps: null, updates: null, happened: null, shown: null, follow: true, error: "" });
    this.plots = [];
    this.build();
    this.ages = setInterval(() => this.facts(), 5000);
    this.facts();
    this.refresh();
  }

  close() {
    this.closed = true;
    clearInterval(this.ages);
    clearTimeout(this.timer);
    this.liveView.close();
    this.whatIf.close();
    for (const plot of this.plots) plot.close();
  }

  redraw() {
    for (const plot of this.plots) plot.redraw();
  }

  update(names) {
    this.facts();
    if (names === null || names.includes(this.name)) this.later();
  }

  later() {
    this.timer ??= setTimeout(() => {
      this.timer = null;
      this.refresh();
    }, REFRESH_MS);
  }

  build() {
    const { name } = this;
    this.tiles = {};
    const tile = (key, label) => {
      this.tiles[key] = [element("dd"), element("dd")];
      return element("div", { class: "fact" }, element("dt", {}, label), ...this.tiles[key]);
    };
    this.alarms = element("div", { class: "alarms", tabindex: "0", role: "region", "aria-label": "Alarms of the last day" }, "Reading …");
    this.trouble = element("p", { class: "error", role: "status" });
    this.fileWords = element("p", { class: "error", role: "alert" });
    this.choice = element("select", { "aria-label": "Window", on: { change: () => this.pick(this.choice.value) } });
    this.rate = element("button", { type: "button", on: { click: () => this.loadWindow(EVERY) } }, "Every sample");
    this.windowFile = element("a", { download: true }, "CSV");
    this.windowNote = element("p", { class: "soft window-note" });
    this.rest = element("p", { class: "rest", role: "status" });
    this.loop = element("div", { class: "hysteresis" });
    this.chain = element("div", { class: "scroll list", tabindex: "0", role: "region", "aria-label": "Updates" });
    this.verification = element("div", { class: "list", tabindex: "0", role: "region", "aria-label": "Verification" });
    this.events = element("div", { class: "scroll list low", tabindex: "0", role: "region", "aria-label": "Events" });
    this.blank = element("p", { class: "empty", hidden: true });
    const plot = (place, options) => {
      this.plots.push(new TimePlot(place, options));
      return this.plots.at(-1);
    };
    this.whatIf = new WhatIfPanel(name, () => this.start());
    this.liveView = new LiveViewPanel(name, () => this.gaps?.machine);
    const chosen = () => (this.shown ? this.shown.split("/") : null);
    this.residualPanel = new ResidualPanel(name, chosen, () => positionUnit(this.gaps.machine).name === "deg");
    this.acts = new ActsPanel(name, () => this.later());
    this.angles = legend(["blue", "motor"], ["orange", "screw or gear, from the position"]);
    const chart = (low) => element("div", { class: low ? "chart low" : "chart" });
    const places = { gap: chart(), tail: chart(true), residual: chart(true), position: chart(), motor: chart(true), voltage: chart(true) };
    this.content = element("div", { class: "unread" },
      panel("Gap over time", [element("a", { href: api.gapsFile(name), download: true }, "CSV"), this.saver(() => api.gapsFile(name, "parquet"))],
        legend(["blue", "estimate"], ["blue band", "95 % interval"], ["green", "wear (trend)"], ["red dash", "limit"], ["orange", "version applied"], ["red dots", "version refused, or fallback"]),
        places.gap),
      panel("Live", [], ...this.liveView.content),
      panel("Window", [this.choice, this.rate, this.windowFile, this.saver(() => this.windowFile.href.replace(/csv$/, "parquet"))], this.windowNote, this.rest,
        element("div", { class: "pair" },
          element("div", {},
            legend(["orange", "reference"], ["blue", "position"]), places.position,
            this.angles, places.motor,
            legend(["blue", "command"]), places.voltage),
          element("div", {}, element("h3", {}, "Hysteresis"),
            element("p", { class: "soft" }, "The motor's lead over the load, against the motor's angle. Backlash opens the loop by the gap; bending between motor and encoder adds to it."),
            this.loop))),
      panel("Residual", this.residualPanel.tools, ...this.residualPanel.content),
      panel("What if", this.whatIf.tools, ...this.whatIf.content),
      panel("Did it help?", [],
        legend(["blue", "of each window"], ["orange", "version applied"]),
        element("div", { class: "two" }, places.tail, places.residual)),
      panel("Updates", [], this.chain),
      panel("Oversight", [], ...this.acts.content),
      panel("Behind the last update", [], this.verification),
      panel("Events", [], this.events));
    this.head = element("div", { class: "head" }, element("h1", {}, name), element("a", { href: api.reportFile(name), download: true }, "Report to mail"), element("a", { href: "#/" }, "All machines"));
    this.tilesList = element("dl", { class: "facts" },
      tile("gap", "Gap, deg (95 %)"), tile("rate", "Wear (95 %)"), tile("limit", "Time to the gap limit"), tile("version", "Version in force"), tile("window", "Last window"), tile("link", "Link"));
    this.view.replaceChildren(this.head, this.tilesList, this.alarms, element("div", { class: "words" }, this.trouble, this.fileWords), this.blank, this.content);
    this.makePlots(plot, places);
    this.plots.push(...this.whatIf.plots, ...this.liveView.plots, ...this.residualPanel.plots);
  }

  // Where a trial on the model begins: at what is known of the machine.
  start() {
    const row = this.live.rows.get(this.name) ?? {};
    return { gap: row.gap, limit: row.gap_limit, setting: settingInForce(this.updates, this.happened, row.version_in_force) };
  }

  makePlots(plot, places) {
    const versions = () => this.marks();
    this.gapPlot = plot(places.gap, {
      time: true, xLabel: "", yLabel: "Gap (deg)", marks: versions,
      series: [
        { label: "high", color: "blue", width: 0 }, { label: "low", color: "blue", width: 0 },
        { label: "accepted", color: "blue", points: true, only: true }, { label: "not accepted", color: "blue", points: true, hollow: true, only: true },
        { label: "trend", color: "green", width: 2, spanGaps: true }, { label: "limit", color: "red", dash: [6, 4], spanGaps: true },
      ],
      bands: [[1, 2, "blue"]], range: around,
    });
    const fromZero = (low, high) => [0, high > 0 ? high * 1.12 : 1];
    this.tailPlot = plot(places.tail, { time: true, yLabel: "Error at the end", marks: versions, range: fromZero, series: [{ label: "error", color: "blue", points: true, spanGaps: true }] });
    this.residualPlot = plot(places.residual, { time: true, yLabel: "Residual, rms", marks: versions, range: fromZero, series: [{ label: "residual", color: "blue", points: true, spanGaps: true }] });
    this.positionPlot = plot(places.position, { sync: "window", yLabel: "Position", series: [{ label: "reference", color: "orange" }, { label: "position", color: "blue" }] });
    this.motorPlot = plot(places.motor, { sync: "window", yLabel: "Angle (deg)", series: [{ label: "motor", color: "blue" }, { label: "screw", color: "orange" }] });
    this.voltagePlot = plot(places.voltage, { sync: "window", xLabel: "Time in the window (s)", yLabel: "Command", series: [{ label: "command", color: "blue" }] });
  }

  async refresh() {
    try {
      const [gaps, updates, happened, oversight] = await Promise.all([api.gaps(this.name), api.updates(this.name), api.events(this.name), api.oversight(this.name)]);
      if (this.closed) return;
      Object.assign(this, { gaps, updates, happened, oversight, error: "" });
    } catch (error) {
      if (this.closed) return;
      this.error = error.message;
      if (error.status === 401) this.live.end(error.message);
      else this.later();
    }
    this.facts();
    if (this.gaps) await this.show();
    if (!this.content.classList.contains("unread")) return;
    await Promise.race([this.liveView.answered, new Promise((resolve) => setTimeout(resolve, REFRESH_MS))]);
    this.content.classList.remove("unread"); // as a whole: nothing moves while the parts come
  }

  // What the rows of the fleet tell: shown at once, and again with every event.
  facts() {
    const row = this.live.rows.get(this.name), now = this.live.now();
    this.content.classList.toggle("stale", this.live.since !== null || this.error !== "");
    setText(this.trouble, this.error ? `${this.error} What is shown may be out of date.` : "");
    const known = this.gaps?.windows.received.length ?? 0;
    this.content.hidden = known === 0;
    this.blank.hidden = known > 0;
    const unknown = !row && this.live.state === "live";
    const none = this.gaps ? "No window of this machine has come yet: there is nothing to estimate from." : "Reading …";
    setText(this.blank, unknown ? "The twin knows no machine of this name." : none);
    if (!row) return;
    const unit = rateUnit([row.rate]), link = linkOf(row, now);
    this.tile("gap", rowGapText(row), [statusText(row.status), travelText(row.gap, row)]);
    this.tile("rate", row.rate === null ? "–" : `${rateText(row.rate, row.rate_interval, unit)} ${unit.name}`, [row.rate === null ? "no trend yet" : "of machine time"]);
    this.tile("limit", limitText(row), [row.gap_limit === null ? "gap_limit_deg is not set" : `limit ${brief(row.gap_limit * DEG)} deg`, limitInterval(row)]);
    this.tile("version", String(row.version_in_force ?? "–"), versionNotes(row));
    this.tile("window", row.last_window ? ago(row.last_window.received, now) : "none yet", [row.last_window ? `number ${row.last_window.sequence} of boot ${row.last_window.boot}` : "", row.waiting ? (row.waiting === 1 ? "1 message waits" : `${row.waiting} messages wait`) : ""]);
    this.tile("link", link.word, [link.note ?? "", row.last_message === null ? "" : `last message ${ago(row.last_message, now)}`]);
    this.tiles.link[0].className = `mark ${link.kind}`;
    const lines = row.alarms.map((alarm) => `${stamp(alarm.time)}: ${alarm.sentence}`);
    this.alarms.classList.toggle("some", lines.length > 0);
    if (this.alarms.dataset.lines !== lines.join("\n")) {
      this.alarms.dataset.lines = lines.join("\n");
      this.alarms.replaceChildren(lines.length ? element("ul", {}, lines.map((line) => element("li", {}, line))) : "No alarm in the last day.");
    }
  }

  // A button that saves a Parquet file, or says why there is none.
  saver(path) {
    const button = element("button", { type: "button", class: "plain", on: { click: () => saved() } }, "Parquet");
    const saved = async () => {
      button.disabled = true;
      setText(this.fileWords, "");
      try {
        await api.save(path());
      } catch (error) {
        setText(this.fileWords, `No Parquet file: ${error.message}`);
      }
      button.disabled = false;
    };
    return button;
  }

  tile(key, value, notes) {
    setText(this.tiles[key][0], value);
    setText(this.tiles[key][1], notes.filter(Boolean).join(", "));
  }

  marks() {
    if (!this.gaps) return [];
    const { versions, fallbacks } = this.gaps;
    const marks = versions.filter((each) => each.applied !== null && each.reason !== FELL_BACK).map((each) => ({
      at: each.answered, word: `v${each.version}`, color: each.applied ? "orange" : "red", dash: !each.applied,
    }));
    marks.push(...fallbacks.map((each) => ({ at: each.time, word: "fallback", color: "red", dash: true })));
    return marks.sort((a, b) => a.at - b.at);
  }

  async show() {
    const { windows, machine } = this.gaps, count = windows.received.length;
    if (!count) return;
    const accepted = windows.kind.map((kind, i) => kind === "glance" || windows.status[i] === "ok");
    const gap = scaled(windows.gap, DEG);
    const limit = machine.gap_limit === null ? null : machine.gap_limit * DEG;
    const high = scaled(windows.high, DEG), top = Math.max(0, ...gap.filter((value) => value !== null)) * 1.5 + 0.1;
    const near = limit !== null && limit < 3 * top ? limit : null;
    const newest = this.live.rows.get(this.name) ?? { gap: null };
    // The last version may have been applied after the last window.
    const [last] = this.marks().map((mark) => mark.at).slice(-1), later = last > windows.received.at(-1) ? [last] : [];
    const time = [...windows.received, ...later];
    this.gapPlot.show([
      time,
      ...[
        high.map((value) => (value === null ? null : Math.min(value, Math.max(top, near ?? 0)))),
        scaled(windows.low, DEG).map((value, i) => (high[i] === null ? null : value)),
        gap.map((value, i) => (accepted[i] ? value : null)), gap.map((value, i) => (accepted[i] ? null : value)),
        scaled(windows.trend, DEG),
      ].map((values) => [...values, ...later.map(() => null)]),
      time.map(() => near),
    ], `Gap over ${count} windows: newest ${gapText(newest.gap, newest.interval)} deg (95 %)`);
    const unit = positionUnit(machine);
    this.tailPlot.options.yLabel = `Error at the end (${unit.name})`;
    this.tailPlot.show([windows.received, scaled(windows.tail, unit.factor)], "Largest tracking error in the last tenth of each window");
    const residual = smallUnit(Math.max(0, ...windows.residual), unit.name === "deg");
    this.residualPlot.options.yLabel = `Residual, rms (${residual[0]})`;
    this.residualPlot.show([windows.received, scaled(windows.residual, residual[1])], "Root mean square of each fit's residual");
    fill(this.chain, chainTable(this.updates, this.gaps, unit));
    fill(this.verification, simulated(this.updates, unit));
    this.acts.show(this.oversight, this.gaps.versions, unit);
    fill(this.events, eventList(this.happened));
    await this.chooseWindows();
  }

  async chooseWindows() {
    const { windows } = this.gaps, keys = windows.sequence.map((sequence, i) => `${windows.boot[i]}/${sequence}`).reverse();
    const listed = keys.slice(0, 100);
    if (this.choice.dataset.newest !== listed[0] || this.choice.options.length !== listed.length) {
      const chosen = this.choice.value;
      this.choice.replaceChildren(...listed.map((key, i) => element("option", { value: key }, `${i ? "" : "newest: "}number ${key.split("/")[1]}, ${stamp(windows.received[windows.received.length - 1 - i])}`)));
      this.choice.dataset.newest = listed[0];
      if (!this.follow && listed.includes(chosen)) this.choice.value = chosen;
    }
    if (this.shown !== this.choice.value) await this.loadWindow(this.columns());
  }

  pick(key) {
    this.follow = this.choice.selectedIndex === 0;
    this.choice.value = key;
    this.loadWindow(this.columns());
  }

  // Two columns of samples per three pixels: more would not be seen.
  columns() {
    return Math.max(100, Math.round(this.positionPlot.place.clientWidth / 1.5));
  }

  async loadWindow(points) {
    const key = this.choice.value, [boot, sequence] = key.split("/");
    this.windowFile.href = `${api.windowPath(this.name, boot, sequence)}/channels.csv`;
    const before = this.shown;
    this.shown = key;
    try {
      let window = await api.channels(this.name, boot, sequence, points);
      if (points === EVERY && window.samples > PART) window = await this.everySample(window, boot, sequence);
      if (this.closed || this.shown !== key) return;
      this.showWindow(window);
    } catch (error) {
      if (this.closed) return;
      if (error.status !== 404) {
        // What was shown stays; the next refresh tries again.
        this.shown = before;
        setText(this.windowNote, before ? `${error.message} What is shown is the window before.` : error.message);
        if (error.status === 401) this.live.end(error.message);
        else this.later();
        return;
      }
      setText(this.rest, "");
      setText(this.windowNote, "The samples of this window are no longer stored.");
      this.loop.replaceChildren();
      for (const plot of [this.positionPlot, this.motorPlot, this.voltagePlot]) if (plot.data) plot.show([[], ...plot.data.slice(1).map(() => [])], "no samples");
    }
  }

  // A long window comes in parts, each of which holds every sample; those at the seams come twice.
  async everySample(window, boot, sequence) {
    const channels = new Map(window.channels.map((each) => [each.name, { ...each, time: [], values: [] }]));
    for (let first = 0; first < window.samples - 1; first += PART - 2) {
      setText(this.windowNote, `Reading sample ${first} of ${window.samples} …`);
      const last = Math.min(first + PART - 3, window.samples - 1);
      const part = await api.channels(this.name, boot, sequence, EVERY, first / window.rate, last / window.rate);
      if (this.closed) return window;
      for (const { name, time, values } of part.channels) {
        const whole = channels.get(name), after = whole.time.at(-1) ?? -1;
        const skip = time.findIndex((each) => each > after);
        for (let i = skip; i >= 0 && i < time.length; i++) {
          whole.time.push(time[i]);
          whole.values.push(values[i]);
        }
      }
    }
    return { ...window, channels: [...channels.values()] };
  }

  showWindow(window) {
    const { machine } = this.gaps, unit = positionUnit(machine);
    const channel = (name) => window.channels.find((each) => each.name === name);
    const position = channel("position"), motor = channel("theta_m"), reference = channel("reference"), command = channel("voltage");
    const kept = Math.max(...window.channels.map((each) => each.values.length));
    const every = kept >= window.samples;
    this.rate.disabled = every;
    setText(this.windowNote, `${duration(window.samples / window.rate)} at ${brief(window.rate)} Hz, sent for: ${window.reason}; version ${window.version} in force. ${every ? "Every sample is shown." : "The least and greatest sample of each column are shown."} Drag to look closer, double click for all; with the keyboard + and −, arrows and 0.`);
    if (window.rest) this.showRest(window.rest, unit);
    this.positionPlot.options.yLabel = `Position (${unit.name})`;
    const joined = (first, second) => uPlot.join([first, second].map((each) => (each ? [each.time, each.values] : [[], []])));
    const stretch = (data, factors) => [data[0], ...data.slice(1).map((values, i) => filled(values).map((value) => (value === null ? null : value * factors[i])))];
    this.positionPlot.show(stretch(joined(reference, position), [unit.factor, unit.factor]), `Reference and position in ${unit.name}`);
    const screw = position && machine.travel ? { time: position.time, values: position.values.map((value) => value / machine.travel) } : null;
    this.angles.firstChild.hidden = !motor;
    this.motorPlot.show(stretch(joined(motor, screw), [DEG, DEG]), motor ? "Angles of motor and screw in degrees" : "Angle of the screw in degrees");
    this.voltagePlot.options.yLabel = `Command (${commandUnit(machine)})`;
    this.voltagePlot.show(command ? [command.time, command.values] : [[], []], `Command in ${commandUnit(machine)}`);
    this.showLoop(motor, position, machine);
  }

  // The limit-cycle indicator.
  showRest({ word, swing, frequency, seconds }, unit) {
    const over = `in the ${brief(seconds)} s after the last step`, size = swing === null ? "" : `± ${brief(swing * unit.factor)} ${unit.name}`;
    const [mark, words] = {
      rest: ["good", `No limit cycle: the load comes to rest ${over}, within ${size}.`],
      "limit cycle": ["bad", `Limit cycle: ${over} the load goes on swinging by ${size}${frequency === null ? "" : ` at ${brief(frequency)} Hz`}.`],
      "swings down": ["none", `The load still swings, but less and less: ${size} at the end, ${brief(frequency)} Hz.`],
      noise: ["none", `The window does not tell whether there is a limit cycle: ${over} the load moves by ${size}, in which the noise of its samples may hide one.`],
      "not seen": ["none", "The window does not tell whether there is a limit cycle: the reference moves, or the time after its last step is too short."],
    }[word];
    this.rest.className = `mark ${mark}`;
    setText(this.rest, words);
  }

  showLoop(motor, position, machine) {
    if (!motor || !position || !machine.travel) {
      this.loop.replaceChildren(element("p", { class: "soft" }, !motor
        ? "The motor has no encoder: the window has no angle of it. Estimates compute the angle from the command, where the drive follows that."
        : "The travel per turn of the motor is unknown until the first estimate."));
      return;
    }
    const [, theta, q] = uPlot.join([[motor.time, motor.values], [position.time, position.values]]);
    const a = filled(theta), b = filled(q), x = [], y = [];
    for (let i = 0; i < a.length; i++) {
      if (a[i] === null || b[i] === null) continue;
      x.push(a[i] * DEG);
      y.push((a[i] - b[i] / machine.travel) * DEG);
    }
    this.loop.replaceChildren(loopPlot(x, y, { xLabel: "Motor (deg)", yLabel: "Motor ahead of the load (deg)", about: "Hysteresis loop of motor and load" }));
  }
}

// A range around the data, wide enough that noise does not look like wear.
function around(low, high) {
  if (low === null || high === null) return [0, 1];
  const least = Math.max(0.15 * Math.abs(high), 0.02), more = Math.max(0, least - (high - low)) / 2 + 0.08 * (high - low);
  return [Math.max(0, low - more), high + more];
}

// Channels are decimated one by one: between its own samples a channel is interpolated.
function filled(values) {
  const made = values.slice();
  let before = -1;
  for (let i = 0; i < made.length; i++) {
    if (made[i] === null || made[i] === undefined) continue;
    for (let k = before + 1; before >= 0 && k < i; k++) made[k] = made[before] + ((made[i] - made[before]) * (k - before)) / (i - before);
    before = i;
  }
  return made.map((value) => (value === undefined ? null : value));
}

// What is known of the versions sent, beside the one in force. A fallback may have the number of an update that met it.
function versionNotes({ version_sent: sent, version_in_force: inForce, receipt }) {
  if (sent === null) return ["none was sent"];
  if (receipt === FELL_BACK) return [FELL_BACK];
  return [sent === inForce ? "the newest that was sent" : `${sent} was sent`, receipt && receipt !== "applied" ? `refused: ${receipt}` : ""];
}

const panel = (title, tools, ...children) =>
  element("section", { class: "panel", "aria-label": title }, element("header", {}, element("h2", {}, title), ...tools), ...children);
