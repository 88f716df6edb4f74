// Draws messages of telemetry; how many pixels of each drawing differ from the first one.
const [messages, done] = arguments;
import("/picture.js").then(({ Picture }) => {
  const canvas = document.createElement("canvas");
  Object.assign(canvas.style, { position: "fixed", width: "600px", height: "500px" });
  document.body.append(canvas);
  const drawings = messages.map((message) => {
    new Picture(canvas).draw(message);
    return new Uint32Array(canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.buffer);
  });
  canvas.remove();
  done(drawings.map((drawing) => drawing.filter((pixel, at) => pixel !== drawings[0][at]).length));
});
