// The fleet: one row per machine; only what is visible is in the document, so that a thousand rows stay fluid.

import * as api from "./api.js";
import { element, setText, svg } from "./dom.js";
import { ago, brief, DEG, limitInterval, limitText, linkOf, rateText, rateUnit, rowGapText, statusText, travelText } from "./format.js";

const earliest = (row) => row.until_limit_interval?.[0] ?? row.until_limit;

const OVERSCAN = 6, HISTORIES = 48, AGES_MS = 5000;
const WIDTH = 120, HEIGHT = 32;
const none = (value, absent) => (value === null || value === undefined ? absent : value);

// Columns: name, head, key of the sort (null sorts last), whether the first click sorts downwards.
const COLUMNS = [
  ["servo", "Machine", (row) => row.servo, false],
  ["gap", "Gap, deg (95 %)", (row) => row.gap, true],
  ["history", "Last windows", null, false],
  ["rate", "Wear (95 %)", (row) => row.rate, true],
  ["limit", "Time to limit", (row) => row.until_limit, false],
  ["version", "Version", (row) => row.version_in_force, true],
  ["window", "Last window", (row) => row.last_window?.received ?? null, true],
  ["link", "Link", (row) => row.last_message, true],
  ["alarms", "Alarms", (row) => row.alarms.length || null, true],
];
const FILTERS = [
  ["all", "all", () => true],
  ["alarms", "with alarms", (row) => row.alarms.length > 0],
  ["limit", "at the limit within 7 days", (row) => (earliest(row) ?? Infinity) < 7 * 86400],
  ["silent", "silent", (row, now) => linkOf(row, now).kind === "bad"],
  ["unknown", "without a gap", (row) => row.gap === null],
];
const remembered = { sort: "servo", down: false, filter: "all", search: "", scroll: 0 };

export class FleetPage {
  constructor(view, live) {
    this.live = live;
    this.pool = new Map();
    this.histories = new Map();
    this.wanted = new Set();
    this.chips = FILTERS.map(([key]) => element("button", { type: "button", on: { click: () => this.choose("filter", key) } }));
    this.search = element("input", {
      type: "search", class: "search", placeholder: "Search machines  ( / )", "aria-label": "Search machines", value: remembered.search,
      on: { input: () => this.choose("search", this.search.value) },
    });
    this.order = element("select", { "aria-label": "Sort by", on: { change: () => this.sortBy(this.order.value) } },
      COLUMNS.filter(([, , key]) => key).map(([name, head]) => element("option", { value: name }, head)));
    this.heads = element("div", { class: "row heads", role: "row", "aria-rowindex": 1 }, COLUMNS.map(([name, head, key]) =>
      element("div", { role: "columnheader", "data-column": name },
        key ? element("button", { type: "button", on: { click: () => this.sortBy(name) } }, head) : element("span", { class: "soft" }, head))));
    this.body = element("div", { class: "rows", role: "rowgroup" });
    this.table = element("div", { class: "table", role: "table", "aria-label": "Machines" },
      element("div", { role: "rowgroup" }, this.heads), this.body);
    this.empty = element("p", { class: "empty", hidden: true });
    this.title = element("h1", {}, "Fleet");
    this.tested = element("span", { class: "soft", role: "status" });
    this.test = element("button", { type: "button", hidden: true, on: { click: () => this.testWebhook() } }, "Test the alarm webhook");
    view.replaceChildren(
      element("div", { class: "head" }, this.title, this.tested, this.test, element("label", { class: "sorting" }, "Sort by", this.order), this.search),
      element("div", { class: "chips head", role: "group", "aria-label": "Filter" }, this.chips),
      this.table, this.empty);
    this.abort = new AbortController();
    const { signal } = this.abort;
    addEventListener("scroll", () => this.scrolled(), { signal, passive: true });
    addEventListener("resize", () => this.schedule(), { signal });
    addEventListener("keydown", (event) => this.key(event), { signal });
    this.ages = setInterval(() => this.schedule(), AGES_MS);
    this.update(null);
    this.offerTest();
    requestAnimationFrame(() => scrollTo(0, remembered.scroll));
  }

  // Engineers may have a test alarm posted, where the twin posts alarms at all.
  async offerTest() {
    try {
      this.test.hidden = !(await api.webhook()).may_test;
    } catch {
      this.test.hidden = true; // the state of the page says what is wrong
    }
  }

  async testWebhook() {
    this.test.disabled = true;
    setText(this.tested, "Posting a test …");
    try {
      const { host, status } = await api.testWebhook();
      setText(this.tested, `${host} took the test (status ${status}).`);
    } catch (error) {
      setText(this.tested, error.message);
    }
    this.test.disabled = false;
  }

  close() {
    this.abort.abort();
    clearInterval(this.ages);
    clearTimeout(this.asking);
    cancelAnimationFrame(this.frame);
  }

  update(names) {
    for (const name of names ?? []) this.wanted.add(name);
    this.sorted = null;
    this.schedule();
  }

  redraw() {
    this.schedule();
  }

  choose(key, value) {
    remembered[key] = value;
    this.sorted = null;
    this.schedule();
  }

  sortBy(name) {
    const down = COLUMNS.find(([key]) => key === name)[3];
    remembered.down = remembered.sort === name ? !remembered.down : down;
    remembered.sort = name;
    this.sorted = null;
    this.schedule();
  }

  schedule() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      this.render();
    });
  }

  scrolled() {
    remembered.scroll = scrollY;
    this.schedule();
  }

  key(event) {
    const typing = event.target.closest?.("input, select, textarea");
    if (event.key === "/" && !typing) {
      event.preventDefault();
      this.search.focus();
    }
    const link = event.target.closest?.(".rows a");
    const step = { ArrowDown: 1, ArrowUp: -1, PageDown: 10, PageUp: -10, End: Infinity, Home: -Infinity }[event.key];
    if (link && step) {
      event.preventDefault();
      this.sorted ??= this.select();  // none since the rows changed
      const place = this.sorted.findIndex((row) => row.servo === link.textContent) + step;
      this.focusRow(Math.max(0, Math.min(this.sorted.length - 1, place)));
    } else if (typing === this.search && event.key === "ArrowDown") this.focusRow(0);
  }

  focusRow(index) {
    this.sorted ??= this.select();
    const row = this.sorted[index];
    if (!row) return;
    const height = this.rowHeight(), top = this.body.getBoundingClientRect().top + scrollY + index * height;
    if (top < scrollY + 7 * 16 || top + height > scrollY + innerHeight) scrollTo(0, top - innerHeight / 2);
    this.render();
    this.pool.get(row.servo)?.cells.servo.querySelector("a").focus({ preventScroll: true });
    this.schedule();
  }

  rowHeight() {
    const sizes = getComputedStyle(document.documentElement);
    return parseFloat(sizes.getPropertyValue("--row")) * parseFloat(sizes.fontSize);
  }

  select() {
    const now = this.live.now(), key = COLUMNS.find(([name]) => name === remembered.sort)[2];
    const rows = [...this.live.rows.values()], wanted = remembered.search.trim().toLowerCase();
    const filter = FILTERS.find(([name]) => name === remembered.filter)[2];
    const chosen = rows.filter((row) => filter(row, now) && row.servo.toLowerCase().includes(wanted));
    const sign = remembered.down ? -1 : 1;
    chosen.sort((a, b) => {
      const x = key(a), y = key(b);
      if (x === null || y === null) return (x === null) - (y === null) || (a.servo < b.servo ? -1 : 1);
      return (x < y ? -sign : x > y ? sign : 0) || (a.servo < b.servo ? -1 : 1);
    });
    this.counts = FILTERS.map(([, , test]) => rows.filter((row) => test(row, now)).length);
    this.unit = rateUnit(rows.map((row) => row.rate));
    return chosen;
  }

  render() {
    this.sorted ??= this.select();
    this.renderHead();
    const height = this.rowHeight(), count = this.sorted.length;
    const top = this.body.getBoundingClientRect().top;
    const first = Math.max(0, Math.floor(-top / height) - OVERSCAN);
    const last = Math.min(count, Math.ceil((innerHeight - top) / height) + OVERSCAN);
    this.body.style.height = `${count * height}px`;
    const shown = new Set();
    for (let index = first; index < last; index++) {
      const row = this.sorted[index];
      shown.add(row.servo);
      this.place(row, index, height);
    }
    for (const [name, drawn] of this.pool) {
      if (!shown.has(name)) {
        drawn.node.remove();
        this.pool.delete(name);
      }
    }
    this.chooseStop(shown, this.sorted[Math.max(0, Math.ceil(-top / height))]?.servo);
    this.askHistories(shown);
  }

  // One row is a stop of the Tab key, the last that had the focus or the first that is seen; arrows move on from there.
  chooseStop(shown, first) {
    const focused = this.body.querySelector("a:focus")?.textContent ?? this.stop;
    this.stop = shown.has(focused) ? focused : first;
    for (const [name, { cells }] of this.pool) cells.servo.firstChild.tabIndex = name === this.stop ? 0 : -1;
  }

  renderHead() {
    FILTERS.forEach(([key, name], i) => {
      setText(this.chips[i], `${this.counts[i]} ${name}`);
      this.chips[i].setAttribute("aria-pressed", String(remembered.filter === key));
    });
    for (const head of this.heads.children) {
      const name = head.dataset.column;
      if (name === "rate") setText(head.firstChild, `Wear, ${this.unit.name}`);
      if (name === remembered.sort) head.setAttribute("aria-sort", remembered.down ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    }
    this.order.value = remembered.sort;
    const known = this.live.rows.size;
    this.table.setAttribute("aria-rowcount", this.sorted.length + 1);
    this.table.hidden = this.sorted.length === 0;
    this.table.classList.toggle("stale", this.live.since !== null);
    this.empty.hidden = this.sorted.length > 0;
    setText(this.empty, known
      ? "No machine matches."
      : this.live.state === "live" ? "No machine has sent anything yet. A machine appears here with the first message of its edge." : "Reading the fleet …");
  }

  place(row, index, height) {
    const drawn = this.pool.get(row.servo) ?? this.make(row);
    if (!drawn.node.isConnected) this.body.append(drawn.node);
    drawn.node.style.transform = `translateY(${index * height}px)`;
    drawn.node.setAttribute("aria-rowindex", index + 2);
    this.fill(drawn.cells, row);
  }

  make(row) {
    const cells = Object.fromEntries(COLUMNS.map(([name]) => [name, element("div", { role: "cell", "data-column": name, class: "number" })]));
    cells.servo.append(element("a", { href: `#/machine/${encodeURIComponent(row.servo)}` }, row.servo), element("small"));
    for (const name of ["gap", "rate", "limit", "version", "link"]) cells[name].append(element("span"), element("small"));
    cells.line = svg("path", { fill: "none", stroke: "currentColor", "stroke-width": "1.6", "vector-effect": "non-scaling-stroke" });
    cells.history.append(svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", "aria-hidden": "true" }, cells.line));
    const drawn = { node: element("div", { class: "row", role: "row" }, COLUMNS.map(([name]) => cells[name])), cells };
    this.pool.set(row.servo, drawn);
    return drawn;
  }

  fill(cells, row) {
    const now = this.live.now(), link = linkOf(row, now);
    setText(cells.servo.lastChild, row.gap === null && !row.status ? "no estimate yet" : statusText(row.status));
    pair(cells.gap, rowGapText(row), travelText(row.gap, row));
    cells.gap.classList.toggle("known", row.gap !== null);
    pair(cells.rate, rateText(row.rate, row.rate_interval, this.unit), row.rate === null ? "no trend yet" : "");
    pair(cells.limit, limitText(row), limitInterval(row));
    pair(cells.version, String(none(row.version_in_force, "–")), row.version_sent !== null && row.version_sent !== row.version_in_force ? `${row.version_sent} sent` : "");
    setText(cells.window, row.last_window ? ago(row.last_window.received, now) : "none yet");
    cells.link.firstChild.className = `mark ${link.kind}`;
    pair(cells.link, link.word, link.note ?? "");
    const [alarm] = row.alarms;
    cells.alarms.className = alarm ? "mark bad" : "soft quiet";
    setText(cells.alarms, alarm ? (row.alarms.length > 1 ? `${row.alarms.length}: ${alarm.sentence}` : alarm.sentence) : "none");
    cells.alarms.title = alarm ? alarm.sentence : "";
    this.drawHistory(cells, row);
  }

  drawHistory(cells, row) {
    const values = (this.histories.get(row.servo) ?? []).filter((value) => value !== null);
    const top = Math.max(...values, 1e-9), span = Math.max(top - Math.min(...values), 0.2 * top), low = Math.max(0, top - span);
    const x = (i) => (values.length > 1 ? (i * (WIDTH - 6)) / (values.length - 1) + 3 : WIDTH / 2);
    const y = (value) => HEIGHT - 3 - ((value - low) / (top - low)) * (HEIGHT - 6);
    const path = values.length === 1 ? `M3 ${y(values[0])}H${WIDTH - 3}` : values.map((value, i) => `${i ? "L" : "M"}${x(i).toFixed(1)} ${y(value).toFixed(1)}`).join("");
    if (cells.line.getAttribute("d") !== path) cells.line.setAttribute("d", path);
    cells.history.title = values.length ? `Gap of the last ${values.length} windows: ${brief(values[0] * DEG)} to ${brief(values.at(-1) * DEG)} deg; the scale is ${brief(low * DEG)} to ${brief(top * DEG)} deg` : "";
  }

  // Short histories of the visible rows, asked for together, at most once a second.
  askHistories(shown) {
    const names = [...shown].filter((name) => !this.histories.has(name) || this.wanted.has(name)).slice(0, HISTORIES);
    if (!names.length || this.asking) return;
    this.asking = setTimeout(async () => {
      try {
        for (const [name, values] of Object.entries(await api.histories(names))) {
          this.histories.set(name, values);
          this.wanted.delete(name);
        }
      } catch {
        for (const name of names) this.wanted.add(name); // the state of the connection is shown above
      }
      this.asking = setTimeout(() => {
        this.asking = null;
        this.schedule();
      }, 1000);
      this.schedule();
    }, 30);
  }
}

function pair(cell, value, note) {
  setText(cell.firstChild, value);
  setText(cell.lastChild, note);
}
