// Logs that are dropped go to the server a few at a time; the list is asked for until nothing is waiting any more.
const drop = document.getElementById("drop"), files = document.getElementById("files");
const progress = document.getElementById("progress"), rows = document.querySelector("#flights tbody");
const AT_ONCE = 3, waiting = [], failed = [];
let sent = 0, total = 0, busy = 0, asking = false;
const tell = () => {
  const lines = [];
  if (busy || waiting.length) lines.push(`Sending: ${sent} of ${total} logs done.`);
  const open = [...rows.rows].filter(row => row.dataset.state !== "done").length;
  if (open) lines.push(`${open} ${open === 1 ? "flight is" : "flights are"} being judged.`);
  progress.replaceChildren(...[...lines, ...failed].map(text => Object.assign(document.createElement("p"), { textContent: text })));
};
const send = async () => {
  while (waiting.length && busy < AT_ONCE) {
    const file = waiting.shift();
    busy++;
    fetch("/flights?name=" + encodeURIComponent(file.name), { method: "PUT", body: file }).then(async answer => {
      const said = await answer.json().catch(() => ({ error: `${file.name}: was not taken (${answer.status})` }));
      if (said.error) failed.push(said.error); else show(said);
    }).catch(() => failed.push(`${file.name}: did not arrive; is servofd still running?`)).finally(() => {
      busy--; sent++; send(); tell(); ask();
    });
  }
  tell();
};
const take = list => { total += list.length; waiting.push(...list); send(); };
const svg = ([columns, below, above]) => {
  if (!columns) return "";
  const NS = "http://www.w3.org/2000/svg", picture = document.createElementNS(NS, "svg");
  for (const [name, value] of Object.entries({ class: "thumbnail", viewBox: `0 0 ${columns} 24`, preserveAspectRatio: "none", "aria-hidden": "true" })) picture.setAttribute(name, value);
  for (const [kind, d] of [["below", below], ["above", above]]) {
    const path = document.createElementNS(NS, "path");
    path.setAttribute("class", kind); path.setAttribute("d", d);
    picture.append(path);
  }
  const line = document.createElementNS(NS, "line");
  for (const [name, value] of Object.entries({ x1: 0, x2: columns, y1: 12, y2: 12 })) line.setAttribute(name, value);
  picture.append(line);
  return picture;
};
const make = (tag, values = {}, ...inside) => {
  const made = Object.assign(document.createElement(tag), values);
  made.append(...inside);
  return made;
};
const show = flight => {
  const old = document.getElementById("f-" + flight.id);
  if (old && old.dataset.state === flight.state) {
    if (old.cells[5].textContent !== flight.sentence) old.cells[5].textContent = flight.sentence;
    return;
  }
  const badge = flight.status ? make("span", { className: "badge " + flight.status }, flight.status.replace("_", " ")) : flight.state;
  const name = make("th", { scope: "row" }, make("a", { href: "/flights/" + flight.id }, flight.name));
  const box = old?.querySelector("input") ?? make("input", { type: "checkbox", name: "flight", value: flight.id, ariaLabel: "Compare " + flight.name });
  const labelled = (label, ...inside) => { const cell = make("td", {}, ...inside); cell.dataset.label = label; return cell; };
  const row = make("tr", { id: "f-" + flight.id }, make("td", {}, badge), name, labelled("begun", flight.begun), labelled("length", flight.duration),
    make("td", {}, svg(flight.thumbnail)), make("td", {}, flight.sentence), labelled("compare", box));
  row.dataset.state = flight.state;
  if (old) old.replaceWith(row); else rows.prepend(row);
  document.getElementById("none").hidden = true;
};
const ask = async () => {
  if (asking) return;
  asking = true;
  try {
    do {
      const flights = await (await fetch("/flights")).json();
      flights.reverse().forEach(show);
      tell();
      if (!busy && !flights.some(flight => flight.state !== "done")) break;
      await new Promise(done => setTimeout(done, 700));
    } while (true);
  } catch { tell(); } finally { asking = false; }
};
files.addEventListener("change", () => { take([...files.files]); files.value = ""; });
for (const name of ["dragenter", "dragover"]) addEventListener(name, event => { event.preventDefault(); drop.classList.add("over"); });
addEventListener("dragleave", event => { if (!event.relatedTarget) drop.classList.remove("over"); });
addEventListener("drop", event => { event.preventDefault(); drop.classList.remove("over"); take([...event.dataTransfer.files]); });
setInterval(ask, 10000);
ask();
