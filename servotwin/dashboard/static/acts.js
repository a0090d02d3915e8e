// Acts of engineers on one machine: hold, release, approve, roll back. Operators see what holds, and what was done.

import * as api from "./api.js";
import { element, fill, setText } from "./dom.js";
import { brief, gapText, stamp } from "./format.js";

const SAID = { hold: "held", release: "released", "roll back": "rolled back", "ask first": "new versions wait for approval", "ask no more": "new versions are sent at once", approve: "approved" };

export class ActsPanel {
  constructor(name, done) {
    Object.assign(this, { name, done, oversight: null });
    this.state = element("p", { role: "status" });
    this.waiting = element("p", { class: "waiting" });
    this.why = element("input", { type: "text", maxlength: 256, "aria-label": "Reason", placeholder: "Reason (stored with the act)" });
    this.version = element("select", { "aria-label": "Version to roll back to" });
    const button = (word, act, named) => element("button", { type: "button", on: { click: () => this.act(act(), named?.()) } }, word);
    this.holding = button("Hold", () => (this.oversight.held ? "release" : "hold"));
    this.asking = button("Ask first", () => (this.oversight.ask_first ? "ask no more" : "ask first"));
    this.approving = button("Approve", () => "approve", () => ({ window: this.oversight.proposal.window }));
    this.back = button("Roll back to", () => "roll back", () => ({ version: this.version.value === "fallback" ? null : Number(this.version.value) }));
    this.error = element("p", { class: "error", role: "alert" });
    this.sent = element("p", { role: "status" });
    this.form = element("div", { class: "acts", hidden: true }, this.why, this.holding, this.asking, this.approving, element("span", { class: "together" }, this.back, this.version));
    this.list = element("div", { class: "scroll list low", tabindex: "0", role: "region", "aria-label": "Acts" });
    this.body = element("div", {}, element("div", { class: "oversight" }, this.state, this.waiting), this.form, element("div", { class: "words" }, this.error, this.sent), this.list);
    this.content = [this.body];
  }

  show(oversight, versions, unit) {
    this.oversight = oversight;
    if (oversight.acts[0]?.done !== this.before) setText(this.sent, "");
    const { held, ask_first: asks, proposal, acts } = oversight;
    const holds = held ? `Held by ${held.who} since ${stamp(held.time)}: ${held.why}. No new version is sent.` : "";
    setText(this.state, [holds, asks ? "Each new version waits for an engineer's approval." : "", !held && !asks ? "Updates are sent as soon as they are verified." : ""].filter(Boolean).join(" "));
    setText(this.waiting, proposal ? proposalText(proposal, unit) : "");
    this.form.hidden = !oversight.may_act;
    this.body.classList.toggle("acting", oversight.may_act); // what an engineer's acts will say has its place
    setText(this.holding, held ? "Release" : "Hold");
    setText(this.asking, asks ? "Ask no more" : "Ask first");
    this.approving.disabled = !proposal;
    const known = [...versions.filter((each) => each.applied).map((each) => each.version).reverse(), 0];
    const listed = [...known.map((version) => [String(version), version ? `version ${version}` : "version 0, of the start"]), ["fallback", "the fallback set"]];
    if (this.version.dataset.listed !== listed.join()) {
      const chosen = this.version.value;
      this.version.dataset.listed = listed.join();
      this.version.replaceChildren(...listed.map(([value, text]) => element("option", { value }, text)));
      if (listed.some(([value]) => value === chosen)) this.version.value = chosen;
    }
    const rows = acts.slice(0, 50).map((act) => element("tr", {},
      element("td", { class: "number" }, stamp(act.time ?? act.done)), element("td", {}, act.who ?? "?"),
      element("td", {}, actText(act)), element("td", {}, act.why ?? ""), element("td", {}, act.outcome)));
    const heads = ["When", "Who", "What", "Why", "Outcome"];
    fill(this.list, rows.length
      ? element("table", {}, element("thead", {}, element("tr", {}, heads.map((head) => element("th", { scope: "col" }, head)))), element("tbody", {}, rows))
      : element("p", { class: "soft" }, "Nobody has acted on this machine."));
  }

  async act(act, named = {}) {
    const why = this.why.value.trim();
    if (!why) {
      setText(this.error, "Give a reason: it is stored with the act.");
      this.why.focus();
      return;
    }
    try {
      this.before = this.oversight.acts[0]?.done;
      await api.act(this.name, { act, why, ...named });
      setText(this.sent, `"${act}" is stored; the twin carries it out as soon as it works on this machine.`);
      this.why.value = "";
      setText(this.error, "");
    } catch (error) {
      setText(this.error, error.message);
    }
    this.done();
  }
}

const actText = (act) => {
  const said = SAID[act.act] ?? act.act;
  if (act.act === "roll back") return `${said} to ${act.version === undefined || act.version === null ? "the fallback set" : `version ${act.version}`}`;
  return act.act === "approve" && act.window ? `${said} the proposal of window ${act.window[1]}` : said;
};

function proposalText(proposal, unit) {
  const { setting, verification, gap, interval } = proposal;
  const verified = verification ? `verified on ${verification.members} simulated machines` : "not simulated";
  const zone = setting?.tolerance ? `dead zone ${brief(setting.tolerance * unit.factor)} ${unit.name}` : "no dead zone";
  return `A new version waits for approval since ${stamp(proposal.created)}: gap ${gapText(gap, interval?.[0] === null ? null : interval)} deg (95 %), ${zone}, ${verified}; of window ${proposal.window?.[1]}.`;
}
