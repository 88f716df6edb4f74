// Draws messages of telemetry; where the parts of the robot are in each drawing, and how many pixels differ from the first one.
const [scene, messages, done] = arguments;
import("/scene.js").then(({ Scene }) => {
  const canvas = new OffscreenCanvas(600, 500), picture = new Scene(canvas), copy = new OffscreenCanvas(600, 500).getContext("2d", { willReadFrequently: true });
  picture.show(scene, { wood: "#e6dfd3", grid: "#cfc6b6", act: "#0b57a4", box: "#0b57a4" });
  picture.look({ eye: [-0.34, -0.85, 0.41], target: [0, 0, 0], width: 600, height: 500, ratio: 1 });
  let first = null;
  const drawings = messages.map((message) => {
    const parts = {};
    picture.draw(message, message.tool ? [message.tool] : []);
    picture.render();
    copy.clearRect(0, 0, 600, 500);
    copy.drawImage(canvas, 0, 0, 600, 500); // in the same task, before the drawing is shown and cleared
    const pixels = new Uint32Array(copy.getImageData(0, 0, 600, 500).data.buffer);
    first ??= pixels;
    picture.scene.traverse((one) => {
      if (!one.name) return;
      one.updateWorldMatrix(true, false);
      if (one.visible) parts[one.name] = { pose: [...one.matrixWorld.elements], solids: one.children.filter((part) => part.isMesh).length };
    });
    return { parts, differing: pixels.filter((pixel, at) => pixel !== first[at]).length };
  });
  picture.renderer.dispose();
  done(drawings);
});
