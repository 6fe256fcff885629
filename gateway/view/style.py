"""The style sheet of the panel, for light and dark, and the script that comes with it."""

from typing import Final

_SCRIPT: Final = """
if (!window.gatewayScript) {
  window.gatewayScript = true;
  document.querySelector(`[style*='width: 20em'] [style*='cursor: pointer']`)?.click();
  let second, changed = performance.now();
  setInterval(() => {
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
a tap on its title opens it. Then it adds a line to the banner while this program does not change the banner.
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
[style*="width: 20em"] { width: 100vw !important }
</style>"""
)
