// Sends which keys are held and how the sticks of a gamepad stand, while the server says that the hand drives.
(() => {
  const path = new URL("mjhab/hand", location.href.split("?")[0].replace(/[^/]*$/, ""));
  path.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  let socket = null;
  let state = { hand: false, keys: [] };
  const held = new Set();
  // A menu keeps the focus after a choice, and would take the keys of the hand as a search.
  const menu = (element) => element.getAttribute("aria-haspopup") === "listbox";
  const typing = (event) => /^(INPUT|TEXTAREA|SELECT)$/.test(event.target.tagName) && !menu(event.target);
  const open = () => {
    socket = new WebSocket(path);
    socket.onmessage = (event) => {
      const drove = state.hand;
      state = JSON.parse(event.data);
      if (!state.hand) held.clear();
      if (state.hand && !drove && document.activeElement) document.activeElement.blur();
    };
    socket.onclose = () => { state = { hand: false, keys: [] }; setTimeout(open, 1000); };
  };
  const send = (value) => { if (socket && socket.readyState === 1) socket.send(JSON.stringify(value)); };
  const take = (event, down) => {
    if (!state.hand || typing(event) || event.ctrlKey || event.metaKey || event.altKey) return;
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
  window.addEventListener("keydown", (event) => take(event, true), true);
  window.addEventListener("keyup", (event) => take(event, false), true);
  window.addEventListener("blur", () => { held.clear(); if (state.hand) report(); });
  // The server lets go of what it has not heard of for a while.
  setInterval(() => { if (state.hand && (held.size || pad())) report(); }, 50);
  open();
})();
