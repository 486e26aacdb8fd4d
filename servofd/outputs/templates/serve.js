// Logs that are dropped go to the server a few at a time; the list is asked for until nothing is waiting any more.
const drop = document.getElementById("drop"), files = document.getElementById("files");
const progress = document.getElementById("progress"), rows = document.querySelector("#flights tbody");
const AT_ONCE = 3, waiting = [], failed = [];
let sent = 0, total = 0, busy = 0, asking = false;
const open = () => [...rows.rows].filter(row => !row.querySelector(".badge"));
const tell = () => {
  const lines = [];
  if (busy || waiting.length) lines.push(`Sending: ${sent} of ${total} logs done.`);
  const left = open().length;
  if (left) lines.push(`${left} ${left === 1 ? "flight is" : "flights are"} being judged.`);
  progress.replaceChildren(...[...lines, ...failed].map(text => Object.assign(document.createElement("p"), { textContent: text })));
};
const send = async () => {
  while (waiting.length && busy < AT_ONCE) {
    const file = waiting.shift();
    busy++;
    fetch("/flights?name=" + encodeURIComponent(file.name), { method: "PUT", body: file }).then(async answer => {
      const said = await answer.json().catch(() => ({ error: `${file.name}: was not taken (${answer.status})` }));
      if (said.error) failed.push(said.error);
    }).catch(() => failed.push(`${file.name}: did not arrive; is servofd still running?`)).finally(() => {
      busy--; sent++; send(); tell(); ask();
    });
  }
  tell();
};
const take = list => { total += list.length; waiting.push(...list); send(); };
// Rows as the server writes them now: new ones on top, changed ones in their place, with their boxes ticked as they are.
const ask = async () => {
  if (asking) return;
  asking = true;
  try {
    do {
      const page = new DOMParser().parseFromString(await (await fetch("/")).text(), "text/html");
      const key = row => row.querySelector("a").getAttribute("href");
      const known = new Map([...rows.rows].map(row => [key(row), row]));
      for (const row of [...page.querySelector("#flights tbody").rows].reverse()) {
        const old = known.get(key(row));
        if (old && old.innerHTML === row.innerHTML) continue;
        if (old) row.querySelector("input").checked = old.querySelector("input").checked;
        if (old) old.replaceWith(row); else rows.prepend(row);
      }
      tell();
      if (!busy && !open().length) break;
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
