// Numbers, units and times as people read them. Inside, everything is SI: rad, m, s; times in s since the epoch.

export const DEG = 180 / Math.PI;
const MINUTE = 60, HOUR = 3600, DAY = 86400, YEAR = 365.25 * DAY;
const UNKNOWN = "–";

const decimalsFor = (spread) => Math.max(0, 1 - Math.floor(Math.log10(spread)));
const DECIMALS = 6; // more are not readable
const SMALL = 1e-3, FINEST = 12; // below: with a power of ten; and what a precise gap may have

export const fixed = (value, decimals) => value.toFixed(decimals).replace("-", "−");

// Three significant digits, without an exponent where that is readable.
export function brief(value) {
  if (value === null || !Number.isFinite(value)) return UNKNOWN;
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-4) return value.toExponential(2).replace("-", "−");
  return fixed(value, Math.min(7, Math.max(0, 2 - Math.floor(Math.log10(size)))));
}

// A value with its 95 % interval: as many digits as the interval deserves.
export function gapText(gap, interval, scale = DEG) {
  if (gap === null) return UNKNOWN;
  if (!interval || interval[0] === null) return brief(gap * scale);
  if (interval[1] === null) return `≥ ${brief(interval[0] * scale)}`;
  const [low, high] = interval.map((end) => end * scale);
  const half = (high - low) / 2;
  if (!(half > 0)) return brief(gap * scale);
  if (decimalsFor(half) > DECIMALS && Math.max(Math.abs(low), Math.abs(high)) < SMALL) return smallText(gap * scale, low, high);
  const decimals = Math.min(FINEST, decimalsFor(half));
  // An interval that ends at zero, or lies otherwise on one side, is not "plus or minus".
  if (Math.abs((high + low) / 2 - gap * scale) > 0.05 * half) return low > 0 ? `${fixed(low, decimals)} to ${fixed(high, decimals)}` : `≤ ${fixed(high, decimals)}`;
  return `${fixed(gap * scale, decimals)} ± ${fixed(half, decimals)}`;
}

// A value and its interval with a common power of ten.
function smallText(value, low, high) {
  const power = Math.floor(Math.log10(Math.max(Math.abs(low), Math.abs(high))));
  return `(${gapText(value / 10 ** power, [low / 10 ** power, high / 10 ** power], 1)}) × 10^${String(power).replace("-", "−")}`;
}

// The gap in a row of the fleet: in brackets where the estimate was not accepted.
export function rowGapText(row) {
  const text = gapText(row.gap, row.interval);
  return row.gap === null || ACCEPTED.includes(row.status) ? text : `(${text})`;
}

const ACCEPTED = ["ok", "nothing moved", "lower bound", ""];

// The store's word for a window that told nothing new is "nothing moved".
export const statusText = (status) => ({ ok: "estimate accepted", "nothing moved": "unchanged", "": "no estimate yet" })[status] ?? status;

// The gap as travel of the load: micrometres or degrees.
export function travelText(gap, row) {
  if (gap === null || !row.travel) return "";
  const bound = row.interval && row.interval[0] !== null && row.interval[1] === null;
  const travel = (bound ? row.interval[0] : gap) * row.travel;
  const text = row.travel_unit === "rad" ? `${brief(travel * DEG)} deg at the load` : `${brief(travel * 1e6)} µm of travel`;
  return bound ? `≥ ${text}` : text;
}

// Unit in which positions of a machine are shown, and its factor; before the first estimate the machine is not known.
const POSITIONS = { rad: { name: "deg", factor: DEG }, m: { name: "mm", factor: 1e3 } };
export const positionUnit = (machine) => POSITIONS[machine?.travel_unit] ?? { name: "m or rad", factor: 1 };

// Unit of the command to a machine's actuator.
export const commandUnit = (machine) => machine?.command_unit || "SI unit";

// One unit for all wear rates of a table, after the largest.
export function rateUnit(rates) {
  const largest = Math.max(0, ...rates.filter((rate) => rate !== null).map(Math.abs)) * DEG;
  if (largest * HOUR >= 0.1) return { name: "deg/h", factor: DEG * HOUR };
  if (largest * DAY >= 0.1) return { name: "deg/day", factor: DEG * DAY };
  return { name: "deg/year", factor: DEG * YEAR };
}

export function rateText(rate, interval, unit) {
  if (rate === null) return UNKNOWN;
  const half = interval ? ((interval[1] - interval[0]) / 2) * unit.factor : 0;
  if (!(half > 0)) return brief(rate * unit.factor);
  const decimals = Math.min(DECIMALS, decimalsFor(half));
  return `${fixed(rounded(rate * unit.factor, half), decimals)} ± ${fixed(rounded(half, half), decimals)}`;
}

// To the two digits that a large interval deserves: 170000, not 171810.
function rounded(value, half) {
  const last = 10 ** (Math.floor(Math.log10(half)) - 1);
  return last > 1 ? Math.round(value / last) * last : value;
}

export function duration(seconds) {
  if (seconds === null || !Number.isFinite(seconds)) return UNKNOWN;
  const steps = [[YEAR, "years"], [DAY, "days"], [HOUR, "h"], [MINUTE, "min"]];
  for (const [size, name] of steps) {
    if (seconds >= 2 * size) return `${seconds / size >= 10 ? Math.round(seconds / size) : fixed(seconds / size, 1)} ${name}`;
  }
  return `${seconds >= 10 || seconds === 0 ? Math.round(seconds) : fixed(seconds, 1)} s`;
}

export const ago = (time, now) => (time === null ? "never" : `${duration(Math.max(0, now - time))} ago`);

export function limitText(row) {
  if (row.gap_limit === null) return "no limit";
  if (row.until_limit === 0) return "reached";
  if (row.until_limit === null && row.until_limit_interval) return "uncertain";
  if (row.until_limit === null) return row.rate === null ? UNKNOWN : "not growing";
  return duration(row.until_limit);
}

export function limitInterval(row) {
  if (!row.until_limit_interval || row.until_limit === 0) return "";
  const [early, late] = row.until_limit_interval;
  return late === null ? `at the earliest in ${duration(early)}` : `${duration(early)} to ${duration(late)}`;
}

export function linkOf(row, now) {
  if (row.connected === true) return { word: "connected", kind: "good" };
  if (row.last_message === null) return { word: "never heard", kind: "none" };
  const silence = now - row.last_message;
  if (row.connected === null && silence < 10 * MINUTE) return { word: "heard", kind: "good" };
  return { word: "silent", kind: "bad", note: `for ${duration(Math.max(0, silence))}` };
}

// Dates as in ISO 8601, in the browser's time zone.
const two = (number) => String(number).padStart(2, "0");
export function stamp(time) {
  const at = new Date(time * 1000);
  return `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())} ${two(at.getHours())}:${two(at.getMinutes())}`;
}
export function clock(time) {
  const at = new Date(time * 1000);
  return `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}`;
}

// The unit in which the largest of small lengths or angles has a readable size; values are in m, rotary: rad.
export function smallUnit(largest, rotary) {
  const units = rotary ? [["rad", 1], ["mrad", 1e3], ["µrad", 1e6]] : [["mm", 1e3], ["µm", 1e6], ["nm", 1e9]];
  return units.find(([, factor]) => largest * factor >= 1) ?? units.at(-1);
}
