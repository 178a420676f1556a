// Light on top of a report that is whole without it: highlights and exact figures in charts, sorted
// tables. Nothing is loaded and nothing leaves the page; texts are set as text, never as markup.
"use strict";
(() => {
  const make = (kind, more) => Object.assign(document.createElement(kind), more);
  const tip = make("div", { className: "tip", hidden: true, role: "status" });
  document.body.append(tip);
  const MOST = 12; // lines of figures at once

  function place(event) {
    const mouse = event?.pointerType === "mouse";
    tip.classList.toggle("corner", !mouse); // under a finger it would be hidden
    tip.style.left = tip.style.top = "";
    if (!mouse) return;
    const right = document.documentElement.clientWidth - tip.offsetWidth - 8;
    const below = event.clientY + 18;
    const fits = below + tip.offsetHeight < window.innerHeight;
    tip.style.left = `${Math.max(8, Math.min(event.clientX + 14, right))}px`;
    tip.style.top = `${fits ? below : Math.max(8, event.clientY - tip.offsetHeight - 12)}px`;
  }

  function show(lines, event) {
    const kept = lines.length > MOST ? [...lines.slice(0, MOST), "…"] : lines;
    tip.replaceChildren(...kept.map((line) => make("div", { textContent: line })));
    tip.hidden = kept.length === 0;
    place(event);
  }

  function untitled(element) { // else the browser shows its own hover text over ours
    const title = element.querySelector(":scope > title");
    if (title) element.setAttribute("aria-label", title.textContent);
    title?.remove();
    return title?.textContent;
  }

  const pins = new Map(); // chart to the function that pins one series of it alone

  function chart(svg) {
    const parts = [...svg.querySelectorAll("[data-series]")];
    const figures = new Map(parts.map((part) => [part.dataset.series, []]));
    const own = new WeakMap();
    const pinned = new Set();
    let over = null;
    untitled(svg);
    for (const part of parts) {
      own.set(part, untitled(part));
      if (own.get(part)) figures.get(part.dataset.series).push(own.get(part));
    }
    const labels = parts.filter((part) => part.matches(".label"));
    labels.forEach((label, i) => Object.assign(label, { tabIndex: i ? -1 : 0, role: "button" }));
    const first = svg.querySelector(".curve");
    for (const curve of svg.querySelectorAll(".curve")) { // a thin line is hard to meet
      const wide = curve.cloneNode();
      wide.setAttribute("class", "hit");
      svg.insertBefore(wide, first);
    }

    function paint() {
      const lit = new Set(over === null ? pinned : [...pinned, over]);
      svg.classList.toggle("dim", lit.size > 0);
      for (const part of parts) part.classList.toggle("lit", lit.has(part.dataset.series));
      for (const label of labels) label.ariaPressed = pinned.has(label.dataset.series);
    }
    function meet(target, event) {
      const part = target.closest("[data-series]");
      over = part ? part.dataset.series : null;
      show(part ? (own.get(part) ? [own.get(part)] : figures.get(over)) : [], event);
      paint();
    }
    function leave() {
      [over, tip.hidden] = [null, true];
      paint();
    }
    function toggle(name) {
      if (name === null) pinned.clear();
      else if (!pinned.delete(name)) pinned.add(name);
      paint();
    }
    svg.addEventListener("pointerover", (event) => meet(event.target, event));
    svg.addEventListener("pointermove", (event) => { if (!tip.hidden) place(event); });
    svg.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") leave(); });
    svg.addEventListener("focusin", ({ target }) => { if (target.matches(":focus-visible")) meet(target); });
    svg.addEventListener("focusout", leave);
    // A finger picks the nearest thing that listens itself: each part does, so that none loses.
    for (const part of svg.querySelectorAll("[data-series]")) {
      part.addEventListener("click", () => toggle(part.dataset.series));
    }
    svg.addEventListener("click", ({ target }) => { if (!target.closest("[data-series]")) toggle(null); });
    svg.addEventListener("keydown", (event) => {
      const step = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 }[event.key];
      if (event.key === "Escape") { leave(); toggle(null); }
      if (!step && event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      if (step) labels.at((labels.indexOf(event.target) + step) % labels.length).focus();
      else toggle(event.target.dataset.series ?? null);
    });
    pins.set(svg, (name) => {
      if (!figures.has(name)) return;
      pinned.clear();
      toggle(name);
    });
  }

  function sortable(table) {
    const body = table.tBodies[0];
    const heads = [...table.tHead.rows[0].cells];
    if (body.rows.length < 2) return;
    heads.forEach((head, column) => {
      const button = make("button", { type: "button", className: "sort" });
      if (head.querySelector("a")) { // the head leads somewhere: the button stands beside it
        button.textContent = "⇅";
        button.setAttribute("aria-label", `sort by ${head.textContent}`);
      } else button.append(...head.childNodes);
      head.append(head.hasChildNodes() ? " " : "", button);
      button.addEventListener("click", () => {
        const up = head.getAttribute("aria-sort") !== "ascending";
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", up ? "ascending" : "descending");
        body.append(...sorted([...body.rows], column, up));
      });
    });
  }

  function sorted(rows, column, up) { // numbers by size, else by letters; what is missing stays last
    const keys = new Map(rows.map((row) => {
      const cell = row.cells[column];
      const text = (cell.dataset.sort ?? cell.textContent).trim();
      return [row, text === "–" ? "" : text];
    }));
    const numeric = [...keys.values()].every((key) => key === "" || Number.isFinite(parseFloat(key)));
    const compare = (a, b) => (numeric ? parseFloat(a) - parseFloat(b) : a.localeCompare(b));
    return rows.sort((one, two) => {
      const [a, b] = [keys.get(one), keys.get(two)];
      if (a === "" || b === "") return (a === "") - (b === "");
      return up ? compare(a, b) : compare(b, a);
    });
  }

  document.querySelectorAll("figure.chart svg").forEach(chart);
  document.querySelectorAll("table.sortable").forEach(sortable);
  document.addEventListener("click", (event) => { // a field of the matrix: its method in its chart
    const link = event.target.closest("a[data-pin]");
    let found = link && document.getElementById(link.hash.slice(1));
    while (found && !found.matches("figure.chart")) found = found.nextElementSibling;
    if (found) pins.get(found.querySelector("svg"))?.(link.dataset.pin);
  });
  document.addEventListener("pointerdown", (event) => {
    if (!event.target.closest("figure.chart svg")) tip.hidden = true;
  });
})();
