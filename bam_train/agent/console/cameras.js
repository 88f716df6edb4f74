// Pictures of cameras, on a socket of their own: the newest only, and the next one when this one was drawn.

import { Connection } from "./connection.js";

export function showCameras(parent) {
  let shown = [];
  const connection = new Connection("/camera", {
    event: (message) => { // the other socket asks for a token
      if (message instanceof ArrayBuffer) draw(message);
      else if (message.cameras) list(message.cameras, message.seen);
      else if (message.camera !== undefined && shown[message.camera]) {
        shown[message.camera].text.textContent = message.error;
        shown[message.camera].at = -Infinity;
      }
    },
  });

  function list(names, seen) {
    shown = names.map((name) => {
      const figure = document.createElement("figure"), caption = document.createElement("figcaption");
      const canvas = document.createElement("canvas"), text = document.createElement("span"), sees = document.createElement("span");
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `Camera ${name}`);
      caption.append(name, sees, text);
      figure.append(canvas, caption);
      canvas.drawn = 0;
      return { figure, canvas, text, sees, size: seen[name], at: -Infinity };
    });
    parent.replaceChildren(...shown.map(({ figure }) => figure));
  }

  async function draw(data) {
    const camera = new Uint8Array(data, 0, 1)[0], place = shown[camera];
    if (place === undefined) return;
    try {
      const picture = await createImageBitmap(new Blob([new Uint8Array(data, 1)]));
      if (place.canvas.width !== picture.width) Object.assign(place.canvas, { width: picture.width, height: picture.height });
      if (place.size) {
        const [width, height] = place.size, whole = picture.width * height === picture.height * width;
        place.sees.textContent = `: ${whole ? "as the policy sees it" : "the policy sees its middle"}, ${width} by ${height} pixels`;
      }
      place.canvas.getContext("2d").drawImage(picture, 0, 0);
      picture.close();
      place.at = performance.now();
      place.canvas.drawn += 1;
    } finally {
      connection.send({ op: "next", camera });
    }
  }

  setInterval(() => {
    for (const { figure, text, at } of shown) {
      const age = (performance.now() - at) / 1000;
      figure.classList.toggle("old", age > 1);
      if (Number.isFinite(age)) text.textContent = age > 1 ? ` (old: ${age.toFixed(0)} s)` : "";
    }
  }, 500);
  return connection;
}
