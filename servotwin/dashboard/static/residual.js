// Residual of a window's fit: what the model leaves, and whether that is white. Computed on request.

import * as api from "./api.js";
import { legend, TimePlot } from "./charts.js";
import { element, setText } from "./dom.js";
import { brief, smallUnit } from "./format.js";

export class ResidualPanel {
  // chosen () => [boot, sequence] of the window that is shown, or null; angular () => the load turns
  constructor(name, chosen, angular) {
    Object.assign(this, { name, chosen, angular });
    this.button = element("button", { type: "button", on: { click: () => this.ask() } }, "Check the window shown");
    this.words = element("p", { role: "status" }, "");
    this.error = element("p", { class: "error", role: "status" });
    const places = [element("div", { class: "chart low" }), element("div", { class: "chart low" })];
    this.residual = new TimePlot(places[0], { xLabel: "Time in the window (s)", yLabel: "Residual", series: [{ label: "residual", color: "blue", width: 1 }] });
    this.correlation = new TimePlot(places[1], {
      xLabel: "Lag (samples of the fit)", yLabel: "Autocorrelation", range: () => [-1, 1],
      series: [
        { label: "high", color: "green", dash: [4, 4], width: 1 }, { label: "low", color: "green", dash: [4, 4], width: 1 },
        { label: "residual", color: "orange" }, { label: "whitened", color: "blue" },
      ],
    });
    this.plots = [this.residual, this.correlation];
    this.legend = legend(["blue", "position less the model's"]);
    this.kind = this.legend.querySelector("span");
    this.body = element("div", { class: "two", hidden: true },
      element("div", {}, this.legend, places[0]),
      element("div", {}, legend(["orange", "of the residual"], ["blue", "after the noise model"], ["green dash", "95 % of white noise"]), places[1]));
    this.tools = [this.button];
    this.content = [
      element("p", { class: "soft" }, "The residual of a window's fit: noise alone, if the model is right. The twin fits the stored window again."),
      this.words, this.error, this.body,
    ];
  }

  async ask() {
    const chosen = this.chosen();
    if (!chosen) return;
    this.button.disabled = true;
    setText(this.error, "");
    setText(this.words, "Fitting the window …");
    this.words.classList.add("begun");
    this.body.hidden = false; // the place of what comes
    try {
      this.show(await api.residual(this.name, ...chosen), chosen);
    } catch (error) {
      setText(this.words, "");
      setText(this.error, `${error.message[0].toUpperCase()}${error.message.slice(1)}${error.message.endsWith(".") ? "" : "."}`);
      this.body.hidden = true;
    }
    this.button.disabled = false;
  }

  show(found, [, sequence]) {
    this.body.hidden = false;
    const [unit, factor] = smallUnit(found.rms, this.angular());
    setText(this.words, `Window number ${sequence}: ${told(found)} Root mean square ${brief(found.rms * factor)} ${unit}.`);
    setText(this.kind, found.of === "motor" ? "motor's angle, at the load, less the model's" : "position less the model's");
    this.residual.options.yLabel = `Residual (${unit})`;
    this.residual.show([found.time, found.residual.map((value) => value * factor)], `Residual of the fit in ${unit}`);
    const lags = found.autocorrelation.map((_, i) => i + 1), band = (sign) => lags.map(() => sign * found.band);
    this.correlation.show([lags, band(1), band(-1), found.autocorrelation, found.autocorrelation_white], "Autocorrelation of the residual, before and after the noise model");
  }
}

function told(found) {
  const counted = `${found.outside} of ${found.lags} autocorrelations lie outside the 95 % band of white noise, where ${Math.round(found.lags / 20)} are expected`;
  const share = `${brief(found.predicted * 100)} % of the residual's variance follows from what came before it`;
  return found.white
    ? `after the noise model the residual is white: ${counted}. ${share}; the noise model takes that out.`
    : `the residual is not white, even after the noise model: ${counted}. ${share}. Something of the machine is not in the model.`;
}
