/* What if: another gap, dead zone or gains on the machine's model; the twin simulates the step. */

import * as api from "./api.js";
import { legend, mapPlot, TimePlot } from "./charts.js";
import { element, setText } from "./dom.js";
import { brief, DEG, positionUnit } from "./format.js";

const PACE_MS = 60; // below the rate that the twin allows an operator
const MAP_MS = 700; // until the next look at a map that is being computed
const STEPS = 400, WIDEST = 3, FACTOR = 4;
// Gains that have a slider, with the unit of each: U command, X travel.
const GAINS = {
  Kp: "U/X", Ki: "U/(X s)", Kd: "U s/X", Tf: "s",
  position_gain: "1/s", velocity_gain: "U s/rad", integral_time: "s", speed_filter: "s",
  gain: "", integral_share: "",
};

export class WhatIfPanel {
  // known () => {gap, limit, setting, machine}: where the sliders begin
  constructor(name, known) {
    Object.assign(this, { name, known, sliders: [], asking: false, again: false });
    this.open = element("button", { type: "button", on: { click: () => this.begin() } }, "Try on the model");
    this.reset = element("button", { type: "button", hidden: true, on: { click: () => this.begin() } }, "As in force");
    this.note = element("p", { class: "soft" }, "Simulates a step of the machine's model with another gap, dead zone or gains. Nothing is sent to the machine.");
    this.words = element("p", { class: "error", role: "status" });
    this.controls = element("div", { class: "sliders" });
    this.place = element("p", { class: "soft map-words" });
    this.map = element("div", { class: "hysteresis map" });
    this.places = { position: element("div", { class: "chart" }), command: element("div", { class: "chart low" }) };
    this.body = element("div", { class: "pair", hidden: true },
      element("div", {}, legend(["orange", "reference"], ["blue", "position"]), this.places.position, legend(["blue", "command"]), this.places.command),
      element("div", {}, this.controls, element("h3", {}, "In the stability map"), this.place, this.map));
    this.tools = [this.open, this.reset];
    this.content = [this.note, this.words, this.body];
    const plot = (place, options) => new TimePlot(place, { xLabel: "Time (s)", ...options });
    this.position = plot(this.places.position, { sync: "what-if", yLabel: "Position", series: [{ label: "reference", color: "orange" }, { label: "position", color: "blue" }] });
    this.command = plot(this.places.command, { sync: "what-if", yLabel: "Command", series: [{ label: "command", color: "blue" }] });
    this.plots = [this.position, this.command];
  }

  async begin() {
    const { gap, setting } = this.known();
    setText(this.words, "");
    setText(this.note, "Starting the simulator …");
    this.note.classList.add("begun");
    this.body.hidden = false; // the place of what comes
    const { type: _type, ...gains } = setting?.gains ?? setting?.law ?? {};
    this.first = null;
    this.asked = { gap: gap ?? 0, tolerance: setting?.tolerance ?? 0, gains };
    await this.ask();
  }

  // One question at a time: of those that come meanwhile, the last is asked.
  async ask() {
    if (this.asking) {
      this.again = true;
      return;
    }
    this.asking = true;
    try {
      do {
        this.again = false;
        const paced = new Promise((resolve) => setTimeout(resolve, PACE_MS));
        this.show(await api.whatIf(this.name, this.asked));
        await paced;
      } while (this.again);
    } catch (error) {
      if (!this.first) setText(this.note, "Nothing was simulated.");
      setText(this.words, error.message);
      this.body.classList.add("stale");
    }
    this.asking = false;
    if (this.again) this.ask();
    else if (this.found?.map.left && !this.words.textContent && !this.closed) this.later ??= setTimeout(() => this.look(), MAP_MS);
  }

  // The map is filled cell by cell: the same question again shows more of it.
  look() {
    this.later = null;
    if (this.closed || document.hidden) return;
    this.ask();
  }

  close() {
    this.closed = true;
    clearTimeout(this.later);
  }

  show(found) {
    const unit = positionUnit(found);
    this.body.hidden = this.reset.hidden = false;
    this.open.hidden = true;
    this.body.classList.remove("stale");
    setText(this.words, "");
    setText(this.note, told(found, unit));
    this.found = found;
    if (!this.first) {
      this.first = found;
      this.makeSliders(found, unit);
    }
    for (const slider of this.sliders) slider.show(found);
    this.showMap(found.map);
    this.position.options.yLabel = `Position (${unit.name})`;
    const scaled = (values) => values.map((value) => value * unit.factor);
    this.position.show([found.time, scaled(found.reference), scaled(found.position)], `Simulated step in ${unit.name}`);
    this.command.options.yLabel = `Command (${found.command_unit})`;
    this.command.show([found.time, found.command], `Command of the simulated step in ${found.command_unit}`);
  }

  showMap(map) {
    if (map.why) {
      setText(this.place, `${map.why[0].toUpperCase()}${map.why.slice(1)}`);
      this.map.replaceChildren();
      return;
    }
    const share = map.settled[map.row][map.column], near = `${brief(map.tolerances[map.row])} and ${brief(map.steps[map.column])}`;
    const here = share === null
      ? "is being computed"
      : `settles from ${Math.round(share * map.starts)} of ${map.starts} starts`;
    const left = map.left ? ` ${map.left} cells are still being computed.` : "";
    setText(this.place, `Dead zone ${brief(map.tolerance)} and step ${brief(map.step)}, each over half the travel in the gap. The nearest cell, ${near}, ${here}. Darker cells settle from more starts.${left}`);
    const mark = { row: placeOf(map.tolerances, map.tolerance), column: placeOf(map.steps.map(Math.log), Math.log(map.step)) };
    this.map.replaceChildren(mapPlot(map.tolerances, map.steps, map.settled, mark, {
      xLabel: "Step over half the travel in the gap", yLabel: "Dead zone over the same",
      about: `Stability map of these gains without sampling and limits: darker cells settle from more of their ${map.starts} starts. ${this.place.textContent}`,
    }));
  }

  makeSliders(found, unit) {
    const { limit } = this.known();
    const widest = Math.min(2 * Math.PI, Math.max(2.5 * found.gap, 1.5 * (limit ?? 0), (0.5 * found.step) / found.travel / 10));
    const dead = Math.max(WIDEST * found.travel * widest, 2 * found.tolerance);
    const linear = (top) => [(value) => (value / top) * STEPS, (place) => (place / STEPS) * top];
    const change = (changes) => {
      this.asked = { ...this.asked, ...changes };
      this.ask();
    };
    const made = [
      new Slider("Gap", "deg", DEG, ...linear(widest), (each) => each.gap, (gap) => change({ gap })),
      new Slider("k_DZ: dead zone over the travel in the gap", "", 1, ...linear(WIDEST), (each) => each.k_dz, (k_dz) => change({ k_dz, tolerance: undefined })),
      new Slider("Dead zone, half-width", unit.name, unit.factor, ...linear(dead), (each) => each.tolerance, (tolerance) => change({ tolerance, k_dz: undefined })),
      new Slider("Step", unit.name, unit.factor, ...ratio(found.step), (each) => each.step, (step) => change({ step })),
      ...Object.entries(GAINS).filter(([name]) => found.gains[name]).map(([name, dimension]) =>
        new Slider(name, dimension.replace("U", found.command_unit).replace("X", found.travel_unit), 1, ...ratio(found.gains[name]),
          (each) => each.gains[name], (value) => change({ gains: { ...this.asked.gains, [name]: value } }))),
    ];
    this.sliders = made;
    this.controls.replaceChildren(...made.map((slider) => slider.row));
  }
}

// Place of a value between rising ones, in steps of the list.
function placeOf(values, value) {
  const above = values.findIndex((each) => each > value);
  if (above < 0) return values.length - 1;
  if (above === 0) return 0;
  return above - 1 + (value - values[above - 1]) / (values[above] - values[above - 1]);
}

// A quarter to four times a value, whatever its sign; in the middle the value itself.
function ratio(start) {
  const half = STEPS / 2;
  return [
    (value) => half + (Math.log(value / start) / Math.log(FACTOR)) * half,
    (place) => start * FACTOR ** ((place - half) / half),
  ];
}

class Slider {
  constructor(label, unit, factor, toPlace, toValue, read, change) {
    Object.assign(this, { unit, factor, toPlace, read });
    this.text = element("output");
    this.input = element("input", {
      type: "range", min: 0, max: STEPS, step: 1,
      on: { input: () => change(toValue(Number(this.input.value))) },
    });
    this.row = element("label", { class: "slider" }, element("span", {}, label), this.text, this.input);
  }

  show(found) {
    const value = this.read(found);
    this.input.disabled = value === null;
    const words = value === null ? "no gap" : `${brief(value * this.factor)} ${this.unit}`.trim();
    setText(this.text, words);
    this.input.setAttribute("aria-valuetext", words);
    const place = value === null ? 0 : Math.round(this.toPlace(value));
    if (document.activeElement !== this.input) this.input.value = Math.min(STEPS, Math.max(0, place));
  }
}

// What came out, in words.
function told(found, unit) {
  const size = (value) => `${brief(value * unit.factor)} ${unit.name}`;
  const end = found.settled !== null
    ? `It settles after ${brief(found.settled)} s, to within ${size(Math.max(found.tolerance, 0.02 * found.step))}.`
    : found.last_motion > 0.02 * found.step
      ? `It does not come to rest: in the last quarter it still moves by ${size(found.last_motion)}.`
      : `It does not settle within ${brief(found.duration)} s.`;
  return `A step of ${size(found.step)} from rest, simulated exactly on the model, without noise and without friction beyond the model's. ${end} Overshoot ${brief(found.overshoot * 100)} %, largest error in the last quarter ${size(found.last_error)}. Without the gap the loop's sensitivity peak is ${brief(found.sensitivity_peak)}.`;
}
