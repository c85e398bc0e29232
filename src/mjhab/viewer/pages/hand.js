// Sends which keys are held and how the sticks of a gamepad stand, while the server says that the hand drives, and at any
// time the key that makes it drive; and once that the home is drawn.
(() => {
  const path = new URL("mjhab/hand", location.href.split("?")[0].replace(/[^/]*$/, ""));
  path.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  let socket = null;
  let state = { hand: false, keys: [], hold: "" };
  const held = new Set();
  // A menu keeps the focus after a choice, and would take the keys of the hand as a search.
  const menu = (element) => element.getAttribute("aria-haspopup") === "listbox";
  const typing = (event) => /^(INPUT|TEXTAREA|SELECT)$/.test(event.target.tagName) && !menu(event.target);
  const open = () => {
    socket = new WebSocket(path);
    socket.onopen = () => { if (drawn) send({ drawn }); };
    socket.onmessage = (event) => {
      const drove = state.hand;
      state = JSON.parse(event.data);
      if (!state.hand) held.forEach((code) => { if (code !== state.hold) held.delete(code); });
      if (state.hand && !drove && document.activeElement) document.activeElement.blur();
    };
    socket.onclose = () => { state = { hand: false, keys: [], hold: "" }; setTimeout(open, 1000); };
  };
  const send = (value) => { if (socket && socket.readyState === 1) socket.send(JSON.stringify(value)); };
  const take = (event, down) => {
    const drives = state.hand || event.code === state.hold;
    if (!drives || typing(event) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (!state.keys.includes(event.code)) return;
    // The page below would move its camera with the same keys.
    event.preventDefault();
    event.stopImmediatePropagation();
    if (down && !event.repeat) held.add(event.code);
    if (!down) held.delete(event.code);
    report();
  };
  const pad = () => [...(navigator.getGamepads ? navigator.getGamepads() : [])].find((p) => p && p.mapping === "standard");
  const report = () => {
    const now = pad();
    send({
      keys: [...held],
      axes: now ? now.axes.map((x) => +x.toFixed(3)) : [],
      buttons: now ? now.buttons.map((b) => +b.value.toFixed(3)) : [],
    });
  };
  // Says once that the page shows a home: an episode waits for it. Browsers without a GPU need half a minute until then.
  const HOME_CORNERS = 15000, SAME_FRAMES = 3, MOST_FRAMES = 30;
  let corners = 0, before = 0, same = 0, big = 0, drawn = false;
  const kinds = [window.WebGL2RenderingContext, window.WebGLRenderingContext].filter((kind) => kind).map((kind) => kind.prototype);
  const originals = kinds.map((kind) => [kind.drawElements, kind.drawElementsInstanced]);
  kinds.forEach((kind, k) => {
    const [one, many] = originals[k];
    kind.drawElements = function (...args) { corners += args[1]; return one.apply(this, args); };
    if (many) kind.drawElementsInstanced = function (...args) { corners += args[1] * args[4]; return many.apply(this, args); };
  });
  const watch = () => {
    // Parts of the home arrive one after the other: it is whole when a frame has as many corners as the ones before.
    if (corners >= HOME_CORNERS) {
      big += 1;
      same = corners === before ? same + 1 : 0;
    }
    before = corners;
    corners = 0;
    if (same < SAME_FRAMES && big < MOST_FRAMES) { requestAnimationFrame(watch); return; }
    drawn = true;
    kinds.forEach((kind, k) => { [kind.drawElements, kind.drawElementsInstanced] = originals[k]; });
    send({ drawn });
  };
  requestAnimationFrame(watch);
  window.addEventListener("keydown", (event) => take(event, true), true);
  window.addEventListener("keyup", (event) => take(event, false), true);
  window.addEventListener("blur", () => { held.clear(); if (state.hand || state.hold) report(); });
  // The server lets go of what it has not heard of for a while.
  setInterval(() => { if ((state.hand || state.hold) && (held.size || pad())) report(); }, 50);
  open();
})();
