"use strict";
const page = JSON.parse(document.getElementById("page-data").textContent);
const dark = window.matchMedia("(prefers-color-scheme: dark)");

const LETTER_PX = 7, TITLE_PX = 9, LINE_PX = 18, MARK_PX = 48;

// Words in lines of at most `most` letters, as plotly breaks them.
function broken(text, most) {
  const lines = [""];
  for (const word of String(text).split(" ").flatMap((part) => part.match(new RegExp(`.{1,${most}}`, "g")) ?? [])) {
    const longer = `${lines.at(-1)} ${word}`.trim();
    if (longer.length <= most) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines.filter((line) => line).join("<br>");
}

// The legend stands above the plot and has room of its own, however many lines it takes at this width.
function withLegend(data, layout, width) {
  const most = Math.max(8, Math.floor((width - MARK_PX) / LETTER_PX));
  const named = data.map((trace) => (trace.name ? { ...trace, name: broken(trace.name, most) } : trace));
  const shown = named.filter((trace) => trace.name && trace.showlegend !== false);
  if (shown.length < 2 && !layout.showlegend) return [named, layout];
  const lines = shown.map((trace) => trace.name.split("<br>"));
  const sizes = lines.map((each) => MARK_PX + LETTER_PX * Math.max(...each.map((line) => line.length)));
  const whole = sizes.reduce((sum, size) => sum + size, 0) <= width;
  const columns = whole ? shown.length : Math.max(1, Math.floor(width / Math.max(...sizes)));
  const tall = Math.max(...lines.map((each) => each.length));
  const room = Math.ceil(shown.length / columns) * tall * LINE_PX + 14;
  const legend = { ...layout.legend, orientation: "h", x: 0, xanchor: "left", y: 1.0, yanchor: "bottom", maxheight: 4096 };
  return [named, { ...layout, legend, height: layout.height + room }];
}

function themed(layout, width) {
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(name).trim();
  const out = structuredClone(layout);
  for (const axis of ["xaxis", "yaxis", "yaxis2"]) {
    if (axis === "yaxis2" && !out.yaxis2) continue;
    out[axis] = { fixedrange: true, automargin: true, gridcolor: color("--grid"), zerolinecolor: color("--grid"), ...out[axis] };
  }
  if (out.xaxis.title?.text) out.xaxis.title.text = broken(out.xaxis.title.text, Math.max(12, Math.floor((width - 90) / TITLE_PX)));
  return {
    dragmode: false,
    // The last number of an axis reaches beyond its end.
    margin: { l: 10, r: 24, t: 10, b: 10 },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: color("--text"), family: getComputedStyle(document.body).fontFamily, size: 13 },
    hoverlabel: { font: { size: 13 } },
    ...out,
  };
}

function draw(id, figure) {
  const place = document.getElementById(id);
  if (!place || !figure) return;
  const [data, layout] = withLegend(figure.data, figure.layout, place.clientWidth);
  Plotly.react(place, data, themed(layout, place.clientWidth), { displayModeBar: false, responsive: true });
}

function drawAll() {
  for (const [id, figure] of Object.entries(page.plots)) draw(id, figure);
  const select = document.getElementById("force-episode");
  if (select) draw("force-plot", page.force[select.selectedIndex]);
}

document.getElementById("force-episode")?.addEventListener("change", drawAll);
dark.addEventListener("change", drawAll);
let drawnWidth = innerWidth;
addEventListener("resize", () => {
  // A phone that is turned; its bars that come and go change the height alone.
  if (innerWidth !== drawnWidth) drawAll();
  drawnWidth = innerWidth;
});
drawAll();

function playable(video) {
  const source = document.getElementById(video.dataset.film);
  const bytes = Uint8Array.from(atob(source.textContent), (letter) => letter.charCodeAt(0));
  source.remove();
  video.src = URL.createObjectURL(new Blob([bytes], { type: "video/mp4" }));
}

for (const film of document.querySelectorAll(".film")) {
  const video = film.querySelector("video");
  const head = film.querySelector(".playhead");
  const now = film.querySelector(".now");
  const steps = Math.max(Number(film.dataset.steps), 1);
  const rate = Number(film.dataset.stepsPerSecond);
  const spans = [...film.querySelectorAll(".span")];
  const hint = now.innerHTML;

  function show(step) {
    head.style.left = `${(100 * Math.min(step, steps)) / steps}%`;
    const span = spans.findLast((each) => Number(each.dataset.step) <= step);
    if (span && step > 0) {
      const [title, rest] = [span.dataset.name, span.dataset.more];
      now.replaceChildren(Object.assign(document.createElement("b"), { textContent: title }), ` ${rest}`);
    } else {
      now.innerHTML = hint;
    }
  }

  if (video) {
    playable(video);
    const follow = () => show(video.currentTime * rate);
    video.addEventListener("timeupdate", follow);
    video.addEventListener("seeking", follow);
    video.addEventListener("play", function frame() {
      follow();
      if (!video.paused && !video.ended) requestAnimationFrame(frame);
    });
  }
  film.addEventListener("click", (event) => {
    const mark = event.target.closest("[data-step]");
    if (!mark) return;
    const step = Number(mark.dataset.step);
    if (video) video.currentTime = step / rate;
    show(step);
    if (mark.classList.contains("tick")) now.textContent = mark.title;
  });
}

for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    head.classList.add("sort");
    head.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
      const order = (a, b) => {
        const [x, y] = [key(a), key(b)];
        return x !== "" && y !== "" && !isNaN(x) && !isNaN(y) ? Number(x) - Number(y) : x.localeCompare(y);
      };
      body.append(...[...body.rows].sort((a, b) => (up ? order(a, b) : order(b, a))));
    });
  });
}
