// Enlarged figures of a report page, and its start: charts are drawn when they come into view.
// A figure, or the column it stands in, over the whole window until it is closed.
const dialog = element("dialog", "enlarged");
const close = element("button", "close", "Close");
let gap = null;
const enlarge = figure => {
  if (dialog.open) return dialog.close();
  const moved = figure.closest(".column") || figure;
  gap = element("div", "gap");
  gap.style.height = moved.offsetHeight + "px";
  moved.replaceWith(gap);
  dialog.append(moved);
  dialog.showModal();
};
close.type = "button";
close.addEventListener("click", () => dialog.close());
dialog.append(close);
dialog.addEventListener("close", () => { gap.replaceWith(dialog.lastElementChild); });

const start = () => {
  document.body.append(dialog);
  const charts = new Map();
  for (const figure of document.querySelectorAll("figure[data-chart]")) {
    charts.set(figure, new Chart(figure));
    figure.removeAttribute("data-chart");
  }
  for (const figure of document.querySelectorAll("figure:not([data-clock])")) {
    const button = element("button", "larger", "Enlarge");
    button.type = "button";
    button.addEventListener("click", () => enlarge(figure));
    figure.prepend(button);
  }
  for (const svg of document.querySelectorAll("figure > svg")) {
    svg.addEventListener("click", () => enlarge(svg.parentElement));
  }
  for (const figure of document.querySelectorAll("figure.wide")) {
    const mark = figure.querySelector('text[style*="--mark"]');
    if (mark) figure.scrollLeft = mark.getBoundingClientRect().left - figure.getBoundingClientRect().left - figure.clientWidth / 2;
  }
  const seen = new IntersectionObserver(entries => {
    for (const entry of entries) if (entry.isIntersecting) {
      seen.unobserve(entry.target);
      charts.get(entry.target).draw();
    }
  }, { rootMargin: "600px" });
  for (const figure of charts.keys()) seen.observe(figure);
  const redraw = () => { for (const chart of charts.values()) if (chart.plot) chart.plot.redraw(false); };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  addEventListener("resize", () => { for (const chart of charts.values()) if (chart.plot) chart.fit(); });
};
addEventListener("DOMContentLoaded", start);
