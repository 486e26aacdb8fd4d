"use strict";
// Tables that are sorted by the column whose heading is pressed; without this they stay as they are, the worst first.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0], key = cell => cell.dataset.sort ?? cell.textContent;
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const sign = down ? -1 : 1;
      const rows = [...body.rows].map(row => [key(row.cells[column]), row]);
      rows.sort(([a], [b]) => !a - !b || sign * a.localeCompare(b, undefined, { numeric: true }));  // what is not known comes last
      body.append(...rows.map(([, row]) => row));
    });
  });
}
