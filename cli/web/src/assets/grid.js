// Moves between the cells of tasks by keys. A picture is one stop of the tab key: the cell that had
// the focus last. Enter opens a cell, as any link.
const main = document.getElementById('main');

main.addEventListener('keydown', (event) => {
  const cell = event.target.closest?.('.grid svg a');
  if (!cell || event.ctrlKey || event.metaKey || event.altKey) return;
  const picture = cell.closest('svg');
  const cells = [...picture.querySelectorAll('a')];
  const row = Number(picture.dataset.row), at = cells.indexOf(cell);
  const to = {
    ArrowLeft: at - 1, ArrowRight: at + 1, ArrowUp: at - row, ArrowDown: at + row,
    Home: 0, End: cells.length - 1,
  }[event.key];
  if (to === undefined) return;
  event.preventDefault();
  cells[to]?.focus();
});

main.addEventListener('focusin', (event) => {
  const cell = event.target.closest?.('.grid svg a');
  if (!cell) return;
  for (const other of cell.closest('svg').querySelectorAll('a[tabindex="0"]')) other.setAttribute('tabindex', '-1');
  cell.setAttribute('tabindex', '0');
});
