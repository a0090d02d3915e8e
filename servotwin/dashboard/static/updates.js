// Updates as the audit chain: window, estimate, verification, version, answer of the edge, effect; and other events.

import { element } from "./dom.js";
import { brief, DEG, gapText, stamp } from "./format.js";

const cell = (content, number = false) => element("td", { class: number ? "number" : "" }, content);
// Answer to an update that was on its way when the edge fell back: nothing is wrong with either.
export const FELL_BACK = "the edge fell back meanwhile";
const percent = (share) => `${brief(share * 100)} %`;

export function chainTable(traces, gaps, unit) {
  const steps = traces.flatMap((trace) => trace.steps.map((step) => ({ trace, step })));
  const open = element("p", { class: "soft" }, newestDecision(gaps, steps.length > 0));
  if (!steps.length) return open;
  const heads = ["Version", "Sent", "Window", "Gap, deg (95 %)", "Setting", "Verified on", "The edge", `End error, before → after (${unit.name})`];
  const table = element("table", {},
    element("thead", {}, element("tr", {}, heads.map((head) => element("th", { scope: "col" }, head)))),
    element("tbody", {}, steps.sort((a, b) => b.step.update.version - a.step.update.version).map(({ trace, step }) => row(trace, step, unit, gaps.machine))));
  return element("div", {}, open, table);
}

// Why the newest window led to no update, where it did not.
function newestDecision(gaps, some) {
  const { reasons, decision } = gaps.windows;
  const why = decision.at(-1) || (reasons.at(-1) ?? []).join("; ");
  const first = some ? "" : "The twin has sent no update yet. ";
  return why ? `${first}The newest window led to none: ${why}.` : first;
}

function row(trace, step, unit, machine) {
  const body = step.update.body ?? {}, { verification } = body;
  const half = body.interval && body.interval[0] !== null ? body.interval : null;
  return element("tr", {},
    cell(String(step.update.version), true), cell(stamp(step.update.created), true), cell(`${trace.window.sequence}`, true),
    cell(gapText(body.gap ?? null, half), true), element("td", { class: "setting" }, settingText(body.setting ?? {}, unit, machine)),
    cell(verification ? `${verification.members} simulated machines` : "not simulated"),
    cell(answerText(step)), cell(refused(step) ? "" : effectText(step.effect, unit), true));
}

// Setting of the version in force: of its update, or as the edge stated it at its start or when it fell back, which may
// have taken the number of an update; null: unknown.
export function settingInForce(traces, events, version) {
  const steps = traces.flatMap((trace) => trace.steps).filter((step) => step.update.version === version && !refused(step));
  const stated = events.find((one) => (one.kind === "hello" && one.version === version) || (one.kind === "fallback" && one.body?.parameter_version === version));
  return steps.at(-1)?.update.body?.setting ?? stated?.body?.setting ?? null;
}

// Dead zone and gains of an update, of any law, with their units.
export function settingText(setting, unit, { command_unit: command, travel_unit: travel }) {
  const parts = [setting.tolerance ? `dead zone ${brief(setting.tolerance * unit.factor)} ${unit.name}` : "no dead zone"];
  const gains = setting.gains ?? {};
  const units = { Kp: `${command}/${travel}`, Ki: `${command}/(${travel} s)`, Kd: `${command} s/${travel}` };
  const named = Object.keys(units).filter((name) => typeof gains[name] === "number");
  if (named.length) parts.push(named.map((name) => `${name} ${brief(gains[name])} ${units[name]}`).join(", "));
  const law = setting.law ?? {}, shown = { position_gain: "1/s", velocity_gain: `${command} s/rad`, integral_time: "s", gain: "", integral_share: "" };
  const numbers = Object.keys(shown).filter((name) => typeof law[name] === "number" && (law[name] || name === "integral_share"));
  if (numbers.length) parts.push(numbers.map((name) => `${name.replace("_", " ")} ${brief(law[name])} ${shown[name]}`.trim()).join(", "));
  const fed = gains.feedforward || law.feedforward;
  if (fed) parts.push(`feedforward ${brief(fed)} ${command}`);
  return parts.join("; ");
}

const answer = (step, kind) => step.answers.find((one) => one.kind === kind);
const refused = (step) => !answer(step, "fallback") && answer(step, "receipt")?.body?.applied === false;

function answerText(step) {
  const receipt = answer(step, "receipt"), fallback = answer(step, "fallback");
  if (fallback) return `left it for its fallback set: ${fallback.status}`;
  if (!receipt) return "has not answered yet";
  if (receipt.status === FELL_BACK) return `did not apply it: ${FELL_BACK}, as version ${receipt.body?.parameter_version}`;
  return receipt.body?.applied ? "applied it" : `refused it: ${receipt.status}`;
}

function effectText(effect, unit) {
  if (!effect) return "no window under it yet";
  const error = (evidence) => (evidence && evidence.tail !== null ? brief(evidence.tail * unit.factor) : "?");
  return `${error(effect.before)} → ${error(effect.after)}`;
}

// The simulated runs behind the last update, and what was not tried.
export function simulated(traces, unit) {
  const trace = traces.find((each) => each.steps.length);
  if (!trace) return element("p", { class: "soft" }, "No update was sent.");
  const { update } = trace.steps.at(-1), { verification } = update.body ?? {};
  if (!verification) {
    return element("p", {}, `Version ${update.version} follows from the estimate by a rule. It was not simulated before it was sent: no other plant, friction, delay or noise was tried.`);
  }
  const redesign = trace.evidence.find((one) => one.kind === "redesign" && one.body?.certificate);
  const tried = [
    `${verification.members} machines, drawn at random from what is stated and learnt, were simulated with this setting; ${percent(verification.settled)} of them settled.`,
    verification.confidence ? `At least ${percent(verification.settled_least)} of such machines settle (confidence ${percent(verification.confidence)}).` : null,
    `Largest overshoot ${percent(verification.overshoot)} of the step, largest error at the end ${brief(verification.tail * unit.factor)} ${unit.name}.`,
    verification.Ms_worst ? `Peak of the sensitivity ${brief(verification.Ms)} on the model, ${brief(verification.Ms_worst)} on the worst plant; least phase margin ${brief(verification.phase_margin_worst * DEG)} deg.` : null,
    `${verification.looked_at} settings were simulated until this one was chosen.`,
    verification.saturated ? "A machine reached the limit of the command." : "No machine reached the limit of the command.",
  ].filter(Boolean);
  const region = redesign?.body.certificate.region ?? null;
  return element("div", {},
    element("p", {}, `Version ${update.version}, for a gap of ${brief((update.body.gap ?? NaN) * DEG)} deg:`),
    element("ul", { class: "simulated" }, tried.map((line) => element("li", {}, line))),
    element("p", { class: "soft" }, `Not tried: gaps${region ? rangeText(region) : ""} and machines outside the ranges that the twin's file states; faults of sensors, drive or structure; references other than steps. A verification in simulation is no proof.`));
}

function rangeText(region) {
  const range = region.gap ?? region.gaps;
  return Array.isArray(range) && range.length === 2 ? ` outside ${brief(range[0] * DEG)} to ${brief(range[1] * DEG)} deg` : "";
}

const HAPPENED = {
  hello: (one) => `edge connected: boot ${one.status}, version ${one.version} in force`,
  fallback: (one) => `fallback from version ${one.version}: ${one.status}`,
  answer: (one) => `the edge answers a request: ${one.status}`,
  act: (one) => one.status,
  alarm: (one) => `alarm: ${one.status}`,
};

export function eventList(events) {
  if (!events.length) return element("p", { class: "soft" }, "Nothing but windows and updates.");
  return element("table", {}, element("tbody", {}, events.map((one) =>
    element("tr", {}, cell(stamp(one.received ?? one.created), true), cell((HAPPENED[one.kind] ?? ((each) => each.status || each.kind))(one))))));
}
