// The page: login, the two views by address, the state of the connection, the theme.

import * as api from "./api.js";
import { element } from "./dom.js";
import { FleetPage } from "./fleet.js";
import { clock } from "./format.js";
import { Live } from "./live.js";
import { MachinePage } from "./machine.js";

const byId = (id) => document.getElementById(id);
const THEMES = ["auto", "light", "dark"];
const HEALTH_MS = 15000;
let page = null;

const live = new Live(
  (names) => {
    showState();
    page?.update(names);
  },
  (why) => {
    showState();
    page?.update([]); // marks it stale
    askToken(why);
  },
);

function showState() {
  const words = {
    starting: byId("login").hidden ? "Connecting …" : "Not logged in",
    live: "Live",
    trouble: live.why,
    away: live.why,
    ended: live.why,
  };
  const kept = live.since === null ? "" : ` What is shown is of ${clock(live.since)}${live.state === "ended" ? "" : "; trying again"}.`;
  byId("state").textContent = words[live.state] + (live.state === "live" ? "" : kept);
}

// What works at the twin, but not as it should: a lag, a clock, a certificate that expires.
async function showDegraded() {
  if (document.hidden || live.state !== "live") return;
  try {
    const { degraded } = await api.health();
    byId("degraded").textContent = degraded.length ? `The twin says: ${degraded.join("; ")}.` : "";
    byId("degraded").hidden = degraded.length === 0;
  } catch {
    // the state of the page says what is wrong
  }
}

function askToken(why) {
  const form = byId("login");
  if (!form.hidden) return;
  byId("login-why").textContent = why;
  form.hidden = false;
  byId("view").hidden = live.rows.size === 0;
  form.classList.toggle("over", !byId("view").hidden); // what is shown stays where it is
  byId("logout").hidden = true;
  showState();
  byId("token").focus();
}

async function submit(event) {
  event.preventDefault();
  const field = byId("token");
  byId("login-error").textContent = "";
  try {
    await api.login(field.value);
    field.value = "";
    await begin();
  } catch (error) {
    byId("login-error").textContent = error.status === 401 || error.status === 403 ? "That is not an operator's token." : error.message;
  }
}

async function begin() {
  const { tokens, admitted } = await api.session();
  if (!admitted) return askToken("");
  byId("login").hidden = true;
  byId("view").hidden = false;
  byId("logout").hidden = !tokens;
  await live.start();
  if (!page) show();
  showDegraded();
}

function show() {
  page?.close();
  const view = byId("view");
  const match = location.hash.match(/^#\/machine\/(.+)$/);
  let name = "";
  try {
    name = match ? decodeURIComponent(match[1]) : "";
  } catch {
    name = "";
  }
  document.title = name ? `${name} – servotwin` : "servotwin";
  page = name ? new MachinePage(view, live, name) : new FleetPage(view, live);
  if (name) scrollTo(0, 0);
  showState();
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  byId("theme").textContent = { auto: "Auto", light: "Light", dark: "Dark" }[theme];
  byId("theme").setAttribute("aria-label", `Theme: ${theme}`);
  try {
    localStorage.setItem("theme", theme);
  } catch {
    // without storage the choice lasts as long as the page
  }
  page?.redraw();
}

function start() {
  let theme = null;
  try {
    theme = localStorage.getItem("theme");
  } catch {
    // as above
  }
  setTheme(THEMES.includes(theme) ? theme : "auto");
  byId("theme").addEventListener("click", () => {
    setTheme(THEMES[(THEMES.indexOf(document.documentElement.dataset.theme) + 1) % THEMES.length]);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => page?.redraw());
  byId("login-form").addEventListener("submit", submit);
  byId("logout").addEventListener("click", async () => {
    await api.logout().catch(() => null);
    location.reload();
  });
  addEventListener("hashchange", () => {
    show();
    byId("view").focus({ preventScroll: true }); // what had the focus is gone
  });
  document.querySelector(".skip").addEventListener("click", (event) => {
    event.preventDefault(); // the part after # is the address of a page here
    (byId("login").hidden ? byId("view") : byId("token")).focus();
  });
  showState();
  setInterval(showDegraded, HEALTH_MS);
  firstTime();
}

async function firstTime() {
  try {
    await begin();
  } catch (error) {
    if (error.status === 401 || error.status === 403) askToken("");
    else {
      live.set("away", error.message);
      showState();
      byId("view").replaceChildren(element("p", { class: "empty" }, `${error.message} Trying again …`));
      setTimeout(firstTime, 2000);
    }
  }
}

start();
