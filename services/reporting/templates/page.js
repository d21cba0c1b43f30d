const number = (text) => parseFloat(text.replace(/,/g, "").replace("−", "-"));
const compare = (left, right, sign) => {
  if (!left || !right) return !left - !right; // empty fields last, either way
  const [a, b] = [number(left), number(right)];
  return sign * (Number.isNaN(a) || Number.isNaN(b) ? left.localeCompare(right) : a - b);
};
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const head = button.closest("th");
    const body = button.closest("table").tBodies[0];
    const descending = head.getAttribute("aria-sort") === "ascending";
    for (const other of head.parentElement.children) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", descending ? "descending" : "ascending");
    const text = (row) => row.children[head.cellIndex].textContent.trim();
    body.append(...[...body.rows].sort((a, b) => compare(text(a), text(b), descending ? -1 : 1)));
  });
}
