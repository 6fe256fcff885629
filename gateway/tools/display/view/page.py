"""What the page of the view has besides viser's: a script and a style sheet."""

from typing import Final

_SCRIPT: Final = """
if (!window.gatewayScript) {
  window.gatewayScript = true;
  document.querySelector(`[style*='width: 20em'] [style*='cursor: pointer']`)?.click();
  const notice = document.createElement('div');
  notice.className = 'gateway-notice';
  document.body.append(notice);
  const places = new Map();
  const spreadLabels = (renderer, scene, camera) => {
    const labels = [], boxes = [], {elements} = camera.matrixWorld;
    scene.traverse(({material, geometry}) => {
      const data = material?.uniforms?.uLabelData?.value.image.data;
      if (!data || material.uniforms.uAtlas) return;
      const {aLabelIndex, aRect, aParams} = geometry.attributes;
      for (let i = 0; i < geometry.instanceCount; i++) {
        const scale = 40 * aParams.getY(i);
        const [left, bottom, width, height] = [0, 1, 2, 3].map(part => scale * aRect.array[4 * i + part]);
        labels.push({data, index: aLabelIndex.getX(i), left, bottom, width, height});
      }
    });
    labels.sort((a, b) => Math.round(b.height - a.height) || a.index - b.index);
    const windowHeight = window.__viserMutable.canvas.clientHeight;
    for (const {data, index, left, bottom, width, height} of labels) {
      const base = 4 * index;
      if (!data[base + 3]) continue;
      const point = camera.position.clone().fromArray(data, base).applyMatrix4(camera.matrixWorldInverse);
      const metres = -2 * point.z * Math.tan(camera.fov * Math.PI / 360) / windowHeight;
      if (metres <= 0) continue;
      const isFree = ([dx, dy]) => {
        const [x, y] = [point.x / metres + left + dx, point.y / metres + bottom + dy];
        const box = [x, y, x + width, y + height];
        if (boxes.some(b => box[0] < b[2] && b[0] < box[2] && box[1] < b[3] && b[1] < box[3])) return false;
        boxes.push(box);
        return true;
      };
      const [dx, dy] = [-2 * Math.max(left, 0) - width - 1, -2 * Math.max(bottom, 0) - height - 1];
      const former = places.get(index) ?? 0;
      const moves = [[0, 0], [dx, 0], [0, dy], [dx, dy]];
      const place = [former, 0, 1, 2, 3].find(each => isFree(moves[each]));
      if (place === undefined) { data[base + 3] = 0; continue; }
      places.set(index, place);
      const [right, up] = moves[place].map(pixels => metres * pixels);
      for (const axis of [0, 1, 2]) data[base + axis] += right * elements[axis] + up * elements[4 + axis];
    }
  };
  let second, changed = performance.now();
  setInterval(() => {
    const canvas = window.__viserMutable?.canvas?.getBoundingClientRect();
    const scene = window.__viserMutable?.scene;
    if (scene) scene.onBeforeRender = spreadLabels;
    if (canvas) [notice.style.left, notice.style.width] = [canvas.left + 'px', canvas.width + 'px'];
    const text = window.__viserSceneTree?.getState()['/notice']?.message.props.text ?? '';
    if (notice.textContent !== text) notice.textContent = text;
    const banner = document.querySelector('[data-second]'), now = performance.now();
    if (!banner) return;
    if (banner.dataset.second !== second) [second, changed] = [banner.dataset.second, now];
    if (now - changed < 4000 || banner.querySelector('.frozen')) return;
    const line = document.createElement('p');
    line.className = 'frozen';
    line.textContent = 'This page gets nothing ' + 'any more. What it shows is old.';
    banner.append(line);
  }, 500);
}
"""
"""Runs once in each page, when the style sheet is loaded: viser offers no other way to add a script.

It closes the sheet that viser shows instead of a panel on narrow screens, where it would cover the picture;
a tap on its title opens it. Then it shows the notice across the top of the picture, and adds a line to the
banner while this program does not change the banner. The notice is the text of a hidden node of the scene,
because a closed panel is not a part of the page.

Before each picture is drawn, ``spreadLabels`` moves labels that overlap to another side of their place, and
hides those for which no side is free. Of two labels, the larger stays, or the older of two that are as large.
It reads viser's buffers: rectangles in pixels of a font, of which 40 times ``aParams.y`` is the size on the
screen, and places with the visibility as the fourth value.
"""

STYLE: Final = (
    f'<style onload="{_SCRIPT}">'
    """
:root { --g-good: #2b8a3e; --g-waiting: #b35900; --g-bad: #c92a2a; --g-line: #0002; --g-on-bad: #fff }
[data-mantine-color-scheme=dark] { --g-good: #69db7c; --g-waiting: #ffc078; --g-bad: #ff8787; --g-line: #fff2;
  --g-on-bad: #2c0b0b }
.gateway { font-size: 12.5px; line-height: 1.45; padding: 2px 12px 4px; overflow-wrap: anywhere }
.gateway h3 { font-size: 13.5px; margin: 6px 0 2px }
.gateway p { margin: 2px 0 }
.gateway table { width: 100%; border-collapse: collapse; margin: 6px 0; font-variant-numeric: tabular-nums }
.gateway th { font-weight: 500; opacity: .65; font-size: 11.5px; vertical-align: bottom }
.gateway th, .gateway td { text-align: right; padding: 2px 0 2px 8px; overflow-wrap: normal }
.gateway td { white-space: nowrap }
.gateway th:first-child, .gateway td:first-child { text-align: left; padding-left: 0 }
.gateway .items td:first-child { white-space: normal; overflow-wrap: anywhere }
.gateway td { border-top: 1px solid var(--g-line) }
.gateway .good { color: var(--g-good) }
.gateway .waiting { color: var(--g-waiting) }
.gateway .bad { color: var(--g-bad) }
.gateway .dim { opacity: .65 }
.gateway .last { float: right; opacity: .65; font-variant-numeric: tabular-nums }
.gateway .stopped { background: var(--g-bad); color: var(--g-on-bad); border-radius: 4px; padding: 5px 8px;
  margin: 4px 0 }
.gateway .items table { table-layout: fixed }
.gateway .items th:nth-child(2) { width: 132px }
.gateway .items th:nth-child(3) { width: 84px }
.gateway .bar { display: inline-block; width: 64px; height: 7px; background: var(--g-line) }
.gateway .share { display: inline-block; width: 56px }
.gateway .legend { font-size: 11.5px }
.gateway .bar i { display: block; height: 100%; background: currentColor }
.gateway .events :is(td, th) { text-align: left }
.gateway .events td:not(:first-child) { white-space: normal; overflow-wrap: anywhere }
.gateway .frozen { background: var(--g-bad); color: var(--g-on-bad); border-radius: 4px; padding: 5px 8px }
.gateway-notice { position: fixed; top: 0; z-index: 5; box-sizing: border-box; padding: 6px 12px;
  background: var(--g-bad); color: var(--g-on-bad); font: 13px/1.4 sans-serif; text-align: center;
  white-space: pre-line; overflow-wrap: anywhere; pointer-events: none }
.gateway-notice:empty { display: none }
[style*="width: 20em"] { width: 100vw !important }
</style>"""
)
