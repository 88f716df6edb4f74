// The texts and controls of a page that contrast too little with what is behind them (WCAG 2.2, AA), with the contrast.
const pixel = document.createElement("canvas").getContext("2d", { willReadFrequently: true });

function rgba(colour) {
  pixel.clearRect(0, 0, 1, 1);
  pixel.fillStyle = colour;
  pixel.fillRect(0, 0, 1, 1);
  return [...pixel.getImageData(0, 0, 1, 1).data];
}

function luminance(colour) {
  const [r, g, b] = rgba(colour).map((one) => (one <= 10 ? one / 255 / 12.92 : ((one / 255 + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
}

function contrast(one, other) {
  const [dark, light] = [luminance(one), luminance(other)].sort((a, b) => a - b);
  return (light + 0.05) / (dark + 0.05);
}

function ground(place) {
  const colour = getComputedStyle(place).backgroundColor;
  return rgba(colour)[3] || place === document.body ? colour : ground(place.parentElement);
}

const places = [...document.querySelectorAll("body *")].filter((place) => place.checkVisibility());
const hasText = (place) => [...place.childNodes].some((part) => part.nodeType === Node.TEXT_NODE && part.textContent.trim());
const texts = places.filter(hasText).map((place) => [place, 4.5, contrast(getComputedStyle(place).color, ground(place))]);
const controls = places.filter((place) => place.matches("button, input")).map((place) => {
  const around = ground(place.parentElement);
  return [place, 3, Math.max(contrast(getComputedStyle(place).borderTopColor, around), contrast(ground(place), around))];
});
return [...texts, ...controls].filter(([, least, is]) => is < least).map(([place, , is]) => [place.id || place.textContent, is]);
