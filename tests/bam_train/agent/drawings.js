// Draws messages of telemetry; where the parts of the robot are in each drawing, and how many pixels differ from the first one.
const [scene, messages, done] = arguments;
import("/picture.js").then(({ Picture }) => {
  const canvas = document.createElement("canvas");
  Object.assign(canvas.style, { position: "fixed", width: "600px", height: "500px" });
  document.body.append(canvas);
  const picture = new Picture(canvas), copy = new OffscreenCanvas(600, 500).getContext("2d", { willReadFrequently: true });
  let first = null;
  const drawings = messages.map((message) => {
    picture.show(scene);
    const known = picture.draw(message), parts = {};
    copy.clearRect(0, 0, 600, 500);
    copy.drawImage(canvas, 0, 0, 600, 500); // in the same task, before the drawing is shown and cleared
    const pixels = new Uint32Array(copy.getImageData(0, 0, 600, 500).data.buffer);
    first ??= pixels;
    picture.scene.traverse((one) => {
      if (!one.name) return;
      one.updateWorldMatrix(true, false);
      if (one.visible) parts[one.name] = { pose: [...one.matrixWorld.elements], solids: one.children.filter((part) => part.isMesh).length };
    });
    return { known, parts, differing: pixels.filter((pixel, at) => pixel !== first[at]).length };
  });
  picture.renderer.dispose();
  canvas.remove();
  done(drawings);
});
