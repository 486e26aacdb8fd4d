// Logs that are dropped go to the server a few at a time; the list is asked for until nothing is waiting any more.
const drop = document.getElementById("drop"), files = document.getElementById("files"), notices = document.getElementById("notices");
const progress = document.getElementById("progress"), rows = document.querySelector("#flights tbody");
const AT_ONCE = 3, AGAIN_MS = 1500, waiting = [];
let sent = 0, total = 0, busy = 0, asking = false, away = false;
const open = () => [...rows.rows].filter(row => !row.querySelector(".badge"));
const tell = () => {
  const lines = [];
  if (away) lines.push("servofd does not answer: it was stopped, or starts again. This page goes on as soon as it is back.");
  if (busy || waiting.length) lines.push(`Sending: ${sent} of ${total} logs done.`);
  const left = open().length;
  if (left && !away) lines.push(`${left} ${left === 1 ? "flight is" : "flights are"} being judged.`);
  if (lines.join() === progress.dataset.said) return;
  progress.dataset.said = lines.join();
  progress.replaceChildren(...lines.map(text => Object.assign(document.createElement("p"), { textContent: text })));
};
const note = (text, id) => {
  const line = document.createElement("li");
  line.textContent = text + " ";
  if (id) line.append(Object.assign(document.createElement("a"), { href: "/flights/" + id, textContent: "Its page" }));
  notices.prepend(line);
};
const pause = ms => new Promise(done => setTimeout(done, ms));
const put = async file => {
  for (;;) {
    try {
      const answer = await fetch("/flights?name=" + encodeURIComponent(file.name), { method: "PUT", body: file });
      const said = await answer.json().catch(() => ({ error: `${file.name}: was not taken (${answer.status}).` }));
      if (said.error || said.notice) note(said.error || said.notice, said.id);
      return;
    } catch {
      try { await file.slice(0, 1).arrayBuffer(); } catch { note(`${file.name}: cannot be read; was it moved, or is it a folder?`); return; }
      away = true; tell();
      await pause(AGAIN_MS);
    }
  }
};
const send = () => {
  while (waiting.length && busy < AT_ONCE) {
    busy++;
    put(waiting.shift()).finally(() => { busy--; sent++; send(); ask(); });
  }
  tell();
};
const take = list => { total += list.length; waiting.push(...list); send(); };
// Rows as the server writes them now, in its order, with their boxes ticked as they are.
const show = page => {
  const key = row => row.querySelector("a").getAttribute("href");
  const known = new Map([...rows.rows].map(row => [key(row), row]));
  const sorted = document.querySelector("#flights [aria-sort]");
  const fresh = [...page.querySelector("#flights tbody").rows].map(row => {
    const old = known.get(key(row));
    known.delete(key(row));
    if (old && old.innerHTML === row.innerHTML) return old;
    if (old) row.querySelector("input").checked = old.querySelector("input").checked;
    if (old && sorted) old.replaceWith(row);
    return row;
  });
  for (const gone of known.values()) gone.remove();
  if (sorted) rows.append(...fresh.filter(row => !row.isConnected));
  else if (fresh.some((row, k) => rows.rows[k] !== row)) rows.replaceChildren(...fresh);
  document.querySelector("#flights caption").textContent = page.querySelector("#flights caption").textContent;
  if (!page.getElementById("preparing")) document.getElementById("preparing")?.remove();
};
const ask = async () => {
  if (asking) return;
  asking = true;
  for (;;) {
    try {
      const answer = await fetch(location.href);
      if (!answer.ok) throw new Error(answer.status);
      show(new DOMParser().parseFromString(await answer.text(), "text/html"));
      away = false;
    } catch { away = true; }
    tell();
    if (!away && !busy && !open().length && !document.getElementById("preparing")) break;
    await pause(away ? AGAIN_MS : 700);
  }
  asking = false;
};
files.addEventListener("change", () => { take([...files.files]); files.value = ""; });
for (const name of ["dragenter", "dragover"]) addEventListener(name, event => { event.preventDefault(); drop.classList.add("over"); });
addEventListener("dragleave", event => { if (!event.relatedTarget) drop.classList.remove("over"); });
addEventListener("drop", event => { event.preventDefault(); drop.classList.remove("over"); take([...event.dataTransfer.files]); });
setInterval(ask, 5000);
ask();
