"use strict";
// Charts: the value under the pointer, a closer view, and what the autopilot did. Without this the page says the same.
for (const chart of document.querySelectorAll(".chart")) {
  const first = +chart.dataset.first, last = +chart.dataset.last, WIDTH = 2000, HEIGHT = 500;
  const plots = [...chart.querySelectorAll(".plot")], fingers = new Map(), ticks = chart.querySelector(".times");
  const readout = chart.querySelector(".readout"), whole = chart.querySelector(".whole");
  const asDrawn = ticks.innerHTML, beside = JSON.parse((chart.closest(".log") ?? document).querySelector("template.lanes")?.content.textContent ?? "{}");
  const { axis, log } = chart.dataset, ofTime = axis === undefined;
  const modes = ofTime && beside.modes || [], said = ofTime && beside.said || [], band = document.createElement("div");
  let from = first, to = last, begun = null, at = null;
  const clock = (t, fine) => {
    const ofDay = t >= 1e8, s = ofDay ? t % 86400 : Math.abs(t), h = Math.floor(s / 3600), m = Math.floor(s / 60) % 60, r = s - 3600 * h - 60 * m;
    const rest = (r < 9.995 ? "0" : "") + r.toFixed(fine ? 2 : 0);
    return (t < 0 ? "-" : "") + (h || ofDay ? h + ":" + String(m).padStart(2, "0") : m) + ":" + rest;
  };
  const named = t => ofTime ? clock(t, true) : `${axis} ${+(log === undefined ? t : 10 ** t).toPrecision(4)}`;
  // Ends of what a plot draws: a lane has its own.
  const ends = plot => [+(plot.dataset.first ?? first), +(plot.dataset.last ?? last)];
  const shownBy = path => getComputedStyle(path).display !== "none";
  // From nearer, the axis of a plot reaches as far as the curves do that are in view.
  const fit = (plot, x, w, near) => {
    for (const one of plot.querySelectorAll(".nearer")) one.remove();
    for (const one of plot.querySelectorAll(".tick, .grid")) one.style.display = near ? "none" : "";
    const svg = plot.querySelector("svg");
    near ||= "first" in plot.dataset;
    let top = 0, bottom = HEIGHT;
    if (near) {
      // A curve that stands still has no point in view: what it is at both ends counts as well.
      const seen = [...plot.querySelectorAll("path[data-name]")].filter(shownBy).flatMap(path => [
        ...points(path).flat().filter(([at]) => at >= x && at <= x + w).map(([, y]) => y), value(path, x), value(path, x + w)])
        .filter(y => y !== null);
      if (seen.length) {
        top = Math.min(...seen); bottom = Math.max(...seen);
        const room = Math.max(.08 * (bottom - top), 8);
        top -= room; bottom += room;
      }
      const low = +plot.dataset.low, high = +plot.dataset.high, at = y => high - y / HEIGHT * (high - low);
      const span = at(top) - at(bottom), power = 10 ** Math.floor(Math.log10(span / 5));
      const step = power * [1, 2, 5, 10, 20].find(k => span / (power * k) <= 5);
      for (let k = Math.ceil(at(bottom) / step); k * step <= at(top); k++) {
        const y = (high - k * step) / (high - low) * HEIGHT, tick = document.createElement("span");
        tick.className = "tick nearer"; tick.style.top = 100 * (y - top) / (bottom - top) + "%"; tick.textContent = +(k * step).toPrecision(6);
        const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
        for (const [name, value] of Object.entries({ class: "grid nearer", x1: x, x2: x + w, y1: y, y2: y })) line.setAttribute(name, value);
        plot.append(tick); svg.prepend(line);
      }
    }
    svg.setAttribute("viewBox", `${x} ${top} ${w} ${bottom - top}`);
  };
  // Modes as bands along the time axis, with a stroke for each message.
  const lay = () => {
    const span = to - from, shown = modes.map(([at, name], k) => [Math.max(at, from), Math.min(modes[k + 1]?.[0] ?? last, to), name, k])
      .filter(([begin, end]) => end > begin);
    band.replaceChildren(...shown.map(([begin, end, name, k]) => {
      const one = document.createElement("span");
      one.className = k % 2 ? "mode odd" : "mode"; one.textContent = one.title = name;
      one.style.left = 100 * (begin - from) / span + "%"; one.style.width = 100 * (end - begin) / span + "%";
      return one;
    }), ...said.filter(([at]) => at >= from && at <= to).map(([at, words]) => {
      const one = document.createElement("i");
      one.title = `${clock(at, true)} ${words}`; one.style.left = 100 * (at - from) / span + "%";
      return one;
    }));
  };
  const show = (a, b) => {
    const span = Math.min(Math.max(b - a, (last - first) / 500), last - first);
    from = Math.min(Math.max(a, first), last - span); to = from + span;
    for (const plot of plots) {
      const [begin, end] = ends(plot);
      fit(plot, (from - begin) / (end - begin) * WIDTH, span / (end - begin) * WIDTH, span < last - first);
    }
    for (const label of chart.querySelectorAll(".label")) {
      const share = (+label.dataset.s - from) / span;
      label.hidden = share < 0 || share > 1;
      label.style.left = 100 * share + "%";
    }
    lay();
    const near = span < last - first;
    whole.hidden = !near;
    if (!near) { ticks.innerHTML = asDrawn; return; }
    if (!ofTime) {
      const real = t => log === undefined ? t : 10 ** t, places = [];
      const low = real(from), high = real(to), power = 10 ** Math.floor(Math.log10((high - low) / 6));
      const step = power * [1, 2, 5, 10, 20].find(k => (high - low) / (power * k) <= 6);
      for (let k = Math.ceil(low / step); k * step <= high; k++) places.push(k * step);
      ticks.replaceChildren(...places.map(x => {
        const tick = document.createElement("span");
        tick.style.left = 100 * ((log === undefined ? x : Math.log10(x)) - from) / span + "%"; tick.textContent = +x.toPrecision(6);
        return tick;
      }));
      return;
    }
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
    if (path.classList.contains("dots")) {
      const near = points(path).flat().map(([at, y]) => [Math.abs(at - x), y]).sort(([a], [b]) => a - b)[0];
      return near && near[0] < WIDTH / 50 * (to - from) / (last - first) ? near[1] : null;
    }
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
    const words = [named(at)];
    for (const plot of plots) {
      const [begin, end] = ends(plot), x = (at - begin) / (end - begin) * WIDTH;
      const low = +plot.dataset.low, high = +plot.dataset.high;
      const line = plot.querySelector(".cursor");
      line.style.left = 100 * (at - from) / (to - from) + "%"; line.hidden = false;
      for (const path of [...plot.querySelectorAll("path[data-name]")].filter(shownBy)) {
        const y = value(path, x);
        if (y !== null) words.push(`${path.dataset.name} ${(high - y / HEIGHT * (high - low)).toFixed(2)} ${plot.dataset.unit}`);
      }
    }
    const mode = modes.findLast(([begin]) => begin <= at), heard = said.filter(([when]) => Math.abs(when - at) <= (to - from) / 100);
    if (mode) words.push(mode[1]);
    readout.textContent = [words.join("   "), ...heard.map(([when, text]) => `${clock(when, true)} “${text}”`)].join("\n");
  };
  const time = (event, plot) => {
    const box = plot.getBoundingClientRect();
    return from + (to - from) * (event.clientX - box.left) / box.width;
  };
  const wire = plot => {
    const chosen = plot.querySelector(".chosen");
    plot.addEventListener("wheel", event => {
      if (!event.ctrlKey && document.activeElement !== area) return;  // the page is scrolled
      event.preventDefault();
      const at = time(event, plot), by = Math.exp(event.deltaY / (event.ctrlKey ? 100 : 500));
      show(at - (at - from) * by, at + (to - at) * by);
    }, { passive: false });
    plot.addEventListener("pointerdown", event => {
      if (event.button === 0) begun = time(event, plot);
      if (event.pointerType === "touch") fingers.set(event.pointerId, event.clientX);
    });
    for (const end of ["pointerup", "pointercancel", "pointerleave"]) plot.addEventListener(end, event => fingers.delete(event.pointerId));
    plot.addEventListener("pointermove", event => {
      if (fingers.size === 2 && fingers.has(event.pointerId)) {
        // Both instants stay under their fingers.
        const box = plot.getBoundingClientRect(), share = x => (x - box.left) / box.width;
        const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, x]) => x), was = fingers.get(event.pointerId);
        fingers.set(event.pointerId, event.clientX);
        const by = (was - other) / (event.clientX - other);
        const fixed = from + (to - from) * share(other);
        if (Number.isFinite(by) && by > 0) show(fixed - (fixed - from) * by, fixed + (to - fixed) * by);
        begun = null; chosen.hidden = true;
        return;
      }
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
  };
  const area = chart.querySelector(".plots");
  plots.forEach(wire);
  if (modes.length || said.length) {
    band.className = "band"; band.setAttribute("aria-hidden", "true");
    ticks.before(band); lay();
  }
  // A name of the legend hides its curve, and what is drawn to it without a name: the other side of a threshold, bars.
  const nameOf = (path, role) => {
    while (path && !(path.dataset.name && path.classList.contains(role))) path = path.previousElementSibling;
    return path?.dataset.name;
  };
  const legend = chart.querySelector(".legend");
  legend.removeAttribute("aria-hidden");
  for (const entry of legend.querySelectorAll("span")) {
    const button = document.createElement("button"), role = entry.className, name = entry.textContent;
    button.type = "button"; button.className = role; button.append(...entry.childNodes); button.setAttribute("aria-pressed", "true");
    button.addEventListener("click", () => {
      const shown = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", shown);
      for (const path of area.querySelectorAll(`path.${role}`)) if ((nameOf(path, role) ?? name) === name) path.style.display = shown ? "" : "none";
      show(from, to);
    });
    entry.replaceWith(button);
  }
  // Other channels of the log, below.
  const all = ofTime && beside.lanes || [];
  if (all.length) {
    const label = document.createElement("label"), choice = document.createElement("select");
    label.className = "more"; label.append("Add a lane ", choice);
    choice.append(new Option("–", ""), ...all.map((lane, k) => new Option(lane.name, k)));
    choice.addEventListener("change", () => {
      const lane = all[choice.value], id = "lane" + choice.value;
      choice.selectedIndex = 0;
      if (!lane || area.querySelector("." + id)) return;
      const axis = document.createElement("p"), plot = document.createElement("div");
      axis.className = "axis"; axis.textContent = lane.name + (lane.unit ? ` [${lane.unit}]` : "");
      plot.className = "plot " + id;
      for (const key of ["low", "high", "unit", "first", "last"]) plot.dataset[key] = lane[key];
      const drawn = (name, values) => {
        const element = document.createElementNS("http://www.w3.org/2000/svg", name);
        for (const [key, value] of Object.entries(values)) element.setAttribute(key, value);
        return element;
      };
      const svg = drawn("svg", { preserveAspectRatio: "none", "aria-hidden": "true" });
      svg.append(drawn("path", { class: "other", "data-name": lane.name, d: lane.path }));
      plot.append(svg, ...["chosen", "cursor"].map(name => Object.assign(document.createElement("span"), { className: name, hidden: true })));
      const away = document.createElement("button");
      away.type = "button"; away.className = "other"; away.textContent = lane.name + " ✕"; away.setAttribute("aria-label", "Remove " + lane.name);
      away.addEventListener("click", () => { away.remove(); axis.remove(); plot.remove(); plots.splice(plots.indexOf(plot), 1); });
      label.before(away);
      (band.isConnected ? band : ticks).before(axis, plot);
      plots.push(plot); wire(plot); show(from, to);
    });
    legend.append(label);
  }
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
}
document.querySelector(".how").hidden = false;
