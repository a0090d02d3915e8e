// One stream of the fleet's changes for all tabs of a browser, which opens no more than six connections to one twin.

const KINDS = ["open", "error", "rows", "links", "alive", "trouble", "reload", "ended"];
const SILENT_MS = 90000; // a tab that ended without a word; hidden ones are slowed down, but have left before
const tabs = new Map(); // port of a tab -> when it was heard
let source = null, position = null;

onconnect = ({ ports: [port] }) => {
  port.onmessage = ({ data }) => {
    if (data === "leave") return leave(port);
    tabs.set(port, Date.now());
    if (data === "here") return;
    follow(data);
    port.postMessage({ type: "joined", readyState: source.readyState });
  };
};

// A tab joins at its own position: from the older of the two on, events come again, which changes nothing for the others.
function follow(after) {
  position = position === null || !source ? after : older(position, after);
  source?.close();
  source = new EventSource(`/v1/fleet/events?after=${position}`);
  for (const kind of KINDS) source.addEventListener(kind, forward);
}

function forward({ type, data, lastEventId, target }) {
  if (lastEventId) position = lastEventId;
  const now = Date.now();
  for (const [port, heard] of tabs) {
    if (now - heard > SILENT_MS) leave(port);
    else port.postMessage({ type, data, lastEventId, readyState: target.readyState });
  }
}

function leave(port) {
  tabs.delete(port);
  if (tabs.size) return;
  source?.close();
  source = null;
}

function older(one, other) {
  const [a, b] = [one, other].map((text) => text.split("-").map(Number));
  return `${Math.min(a[0], b[0])}-${Math.min(a[1], b[1])}`;
}
