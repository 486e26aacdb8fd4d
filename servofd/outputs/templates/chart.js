"use strict";
// Charts: the value under the pointer, and a view from nearer. Without this the page says the same.
for (const chart of document.querySelectorAll(".chart")) {
  const first = +chart.dataset.first, last = +chart.dataset.last, WIDTH = 4000, HEIGHT = 1000;
  const plots = [...chart.querySelectorAll(".plot")], ticks = chart.querySelector(".times");
  const readout = chart.querySelector(".readout"), whole = chart.querySelector(".whole");
  const asDrawn = ticks.innerHTML;
  let from = first, to = last, begun = null, at = null;
  const clock = (t, fine) => {
    const s = Math.abs(t), h = Math.floor(s / 3600), m = Math.floor(s / 60) % 60, r = s - 3600 * h - 60 * m;
    const rest = (r < 9.995 ? "0" : "") + r.toFixed(fine ? 2 : 0);
    return (t < 0 ? "-" : "") + (h ? h + ":" + String(m).padStart(2, "0") : m) + ":" + rest;
  };
  const show = (a, b) => {
    const span = Math.min(Math.max(b - a, (last - first) / 500), last - first);
    from = Math.min(Math.max(a, first), last - span); to = from + span;
    const x = (from - first) / (last - first) * WIDTH, w = span / (last - first) * WIDTH;
    for (const plot of plots) plot.querySelector("svg").setAttribute("viewBox", `${x} 0 ${w} ${HEIGHT}`);
    for (const label of chart.querySelectorAll(".label")) {
      const share = (+label.dataset.s - from) / span;
      label.hidden = share < 0 || share > 1;
      label.style.left = 100 * share + "%";
    }
    const near = span < last - first;
    whole.hidden = !near;
    if (!near) { ticks.innerHTML = asDrawn; return; }
    const step = [.05, .1, .2, .5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1800, 3600].find(s => span / s <= 6) || 7200;
    ticks.replaceChildren();
    for (let k = Math.ceil(from / step); k * step <= to; k++) {
      const tick = document.createElement("span");
      tick.style.left = 100 * (k * step - from) / span + "%";
      tick.textContent = clock(k * step, step < 1);
      ticks.append(tick);
    }
  };
  const points = path => path.points ??= path.getAttribute("d").split("M").slice(1).map(piece => {
    const n = piece.match(/-?\d+/g).map(Number), all = [[n[0], n[1]]];
    for (let i = 2; i + 1 < n.length; i += 2) all.push([all.at(-1)[0] + n[i], all.at(-1)[1] + n[i + 1]]);
    return all;
  });
  const value = (path, x) => {
    for (const piece of points(path)) {
      if (x < piece[0][0] || x > piece.at(-1)[0]) continue;
      let low = 0, high = piece.length - 1;
      while (high - low > 1) { const mid = low + high >> 1; if (piece[mid][0] <= x) low = mid; else high = mid; }
      const [x0, y0] = piece[low], [x1, y1] = piece[high];
      return x1 > x0 ? y0 + (y1 - y0) * (x - x0) / (x1 - x0) : y0;
    }
    return null;
  };
  const tell = t => {
    at = Math.min(Math.max(t, from), to);
    const x = (at - first) / (last - first) * WIDTH, words = [clock(at, true)];
    for (const plot of plots) {
      const low = +plot.dataset.low, high = +plot.dataset.high;
      const line = plot.querySelector(".cursor");
      line.style.left = 100 * (at - from) / (to - from) + "%"; line.hidden = false;
      for (const path of plot.querySelectorAll("path[data-name]")) {
        const y = value(path, x);
        if (y !== null) words.push(`${path.dataset.name} ${(high - y / HEIGHT * (high - low)).toFixed(2)} ${plot.dataset.unit}`);
      }
    }
    readout.textContent = words.join("   ");
  };
  const time = (event, plot) => {
    const box = plot.getBoundingClientRect();
    return from + (to - from) * (event.clientX - box.left) / box.width;
  };
  for (const plot of plots) {
    const chosen = plot.querySelector(".chosen");
    plot.addEventListener("pointerdown", event => { if (event.button === 0) begun = time(event, plot); });
    plot.addEventListener("pointermove", event => {
      const now = time(event, plot);
      tell(now);
      chosen.hidden = begun === null || !event.buttons;
      if (chosen.hidden) { begun = null; return; }
      const [a, b] = [begun, now].map(t => 100 * (t - from) / (to - from)).sort((p, q) => p - q);
      chosen.style.left = a + "%"; chosen.style.width = b - a + "%";
    });
    plot.addEventListener("pointerup", event => {
      const now = time(event, plot);
      chosen.hidden = true;
      if (begun !== null && Math.abs(now - begun) > .02 * (to - from)) show(Math.min(begun, now), Math.max(begun, now));
      begun = null;
    });
    plot.addEventListener("pointerleave", () => { chosen.hidden = true; begun = null; });
    plot.addEventListener("dblclick", () => show(first, last));
  }
  const area = chart.querySelector(".plots");
  area.addEventListener("keydown", event => {
    const middle = at ?? (from + to) / 2, span = to - from;
    const keys = {
      "+": () => show(middle - span / 4, middle + span / 4), "-": () => show(middle - span, middle + span),
      "0": () => show(first, last), Escape: () => show(first, last),
      ArrowLeft: () => { if (event.shiftKey) show(from - span / 4, to - span / 4); tell(middle - span / 100); },
      ArrowRight: () => { if (event.shiftKey) show(from + span / 4, to + span / 4); tell(middle + span / 100); },
    };
    if (keys[event.key]) { keys[event.key](); event.preventDefault(); }
  });
  whole.addEventListener("click", () => show(first, last));
  chart.querySelector(".how").hidden = false;
}
