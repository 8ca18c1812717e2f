// Tables that are sorted by a click on the head of a column; a third click restores the order of the page.

function sortValue(row, column) {
  const cell = row.cells[column];
  return cell.dataset.value !== undefined ? Number(cell.dataset.value) : cell.textContent.trim();
}

function compareValues(a, b) {
  if (typeof a === "number" && typeof b === "number") return a - b;
  if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1; // what has no number comes last
  return a.localeCompare(b, undefined, { numeric: true });
}

function makeSortable(table) {
  const heads = [...table.tHead.rows[0].cells];
  const body = table.tBodies[0];
  const first = [...body.rows];
  const orders = ["none", "ascending", "descending"];
  heads.forEach((head, column) => {
    head.setAttribute("aria-sort", "none");
    const sort = () => {
      const order = orders[(orders.indexOf(head.getAttribute("aria-sort")) + 1) % orders.length];
      for (const other of heads) other.setAttribute("aria-sort", "none");
      head.setAttribute("aria-sort", order);
      const rows = [...first];
      const sign = order === "descending" ? -1 : 1;
      if (order !== "none") rows.sort((a, b) => sign * compareValues(sortValue(a, column), sortValue(b, column)));
      body.append(...rows);
    };
    const words = head.textContent;
    if (words) head.replaceChildren(element("button", { type: "button", title: `sort by ${words}`, onclick: sort }, words));
  });
}
