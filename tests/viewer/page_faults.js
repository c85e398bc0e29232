// What is wrong with the layout of a page in the common style, as sentences; none is good.
(() => {
  const told = [], width = innerWidth;
  const rect = (e) => e.getBoundingClientRect();
  const start = (e) => e.textContent.trim().slice(0, 40);
  if (document.scrollingElement.scrollWidth > width) told.push(`the page is ${document.scrollingElement.scrollWidth} px wide`);
  for (const e of document.querySelectorAll("body *")) {
    if (e.closest("svg, .scroll") || ["SCRIPT", "STYLE"].includes(e.tagName)) continue;
    if (rect(e).width && rect(e).right > width + 1) told.push(`${e.tagName} "${start(e)}" ends at ${Math.round(rect(e).right)} px`);
  }
  for (const e of document.querySelectorAll("dd, dt, td, th, p, h1, h2, h3, .chip, .value, .name")) {
    if (e.textContent.trim().length > 8 && rect(e).width > 0 && rect(e).width < 40) told.push(`"${start(e)}" is ${Math.round(rect(e).width)} px wide`);
  }
  for (const plot of document.querySelectorAll(".js-plotly-plot")) {
    const areas = [...plot.querySelectorAll(".nsewdrag")].map(rect), whole = rect(plot.querySelector(".main-svg"));
    const legend = plot.querySelector(".legend");
    for (const area of areas) {
      if (area.height < 90 || area.width < 120) told.push(`${plot.id} draws on ${Math.round(area.width)} x ${Math.round(area.height)} px`);
      if (!legend) continue;
      const l = rect(legend);
      if (l.left < area.right - 1 && l.right > area.left + 1 && l.top < area.bottom - 1 && l.bottom > area.top + 1) told.push(`the legend lies on the curve of ${plot.id}`);
    }
    for (const e of plot.querySelectorAll(".xtick text, .ytick text, .xtitle, .ytitle, .legendtext")) {
      const r = rect(e);
      if (r.right > whole.right + 1 || r.left < whole.left - 1 || r.bottom > whole.bottom + 1 || r.top < whole.top - 1) told.push(`"${start(e)}" of ${plot.id} is cut`);
    }
    if (!plot.data.some((trace) => (trace.y ?? []).length)) told.push(`${plot.id} has no data`);
  }
  return told;
})()
