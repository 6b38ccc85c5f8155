const rows = JSON.parse(document.getElementById("rows").textContent), detail = document.getElementById("detail");
function cell(text, kind) { const one = document.createElement(kind); one.textContent = text; return one; }
document.addEventListener("click", event => {
  const task = event.target.dataset && event.target.dataset.t, row = task && rows[task];
  if (!row) return;
  detail.replaceChildren(cell("Task " + task, "h3"));
  const made = document.createElement("table");
  for (const [name, value] of Object.entries(row)) {
    const line = made.insertRow();
    line.append(cell(name, "th"), cell(value === null ? "" : value, "td"));
  }
  detail.append(made);
  if (row.plan) {
    const where = decodeURI(location.pathname).replace(/[^/]*$/, "") + row.plan;
    const link = cell("the archive with its plan", "a");
    link.href = row.plan.replace(/\/[^/]*$/, "");
    detail.append(link, cell("planner report " + where + "\nplanner render " + where, "pre"));
  }
});
