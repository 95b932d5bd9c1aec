"""Stylesheet of the page: one column of cards, light or dark as the reader's system, and for print.

A table that is wider than its card scrolls, with a shadow at the side that has more; on a phone the rows of a wide one
are cards.
"""

STYLESHEET = """
:root { color-scheme: light dark; --ink: #1f2933;
  --soft: #5b6672; --faint: #d3d9e0; --paper: #ffffff; --ground: #f3f5f7;
  --model: #0b6cab; --mark: #b84a00; --other: #0b7558; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e9ee; --soft: #a3aeba; --faint: #3a444f; --paper: #1a2027;
  --ground: #11151a; --model: #63b3ed; --mark: #ff9a5a; --other: #4cc9a0; } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--ground); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Noto Sans", sans-serif; overflow-wrap: anywhere; }
main { max-width: 1260px; margin: 0 auto; padding: 1.5rem 1rem 3rem; }
h1 { font-size: 1.05rem; font-weight: 600; color: var(--soft); margin: 0 0 .5rem; }
h2 { font-size: 1.55rem; line-height: 1.25; margin: .2rem 0 .4rem; text-wrap: balance; }
h3 { font-size: 1.1rem; margin: 0 0 .6rem; }
p { margin: .4rem 0; max-width: 72ch; }
a { color: var(--model); }
nav { position: sticky; top: 0; z-index: 5; display: flex; flex-wrap: wrap; gap: .1rem 1.1rem;
  background: var(--ground); padding: .4rem 0; font-size: .9rem; }
nav a { text-decoration: none; } nav a:hover { text-decoration: underline; }
section, article { scroll-margin-top: 4rem; }
.lead { display: grid; grid-template-columns: minmax(0, 5fr) minmax(0, 7fr); gap: 1rem; margin: 1rem 0; }
.findings { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 270px), 1fr)); }
.findings > :first-child { grid-column: 1 / -1; } .lead section, .findings section { margin: 0; min-width: 0; }
.findings p, .findings ul { font-size: .95rem; }
.findings figure { max-width: 24rem; } .findings figure[data-clock] { max-width: 40rem; }
h4 { font-size: 1rem; margin: 1rem 0 .4rem; }
article + article { margin-top: 3rem; }
section { background: var(--paper); border: 1px solid var(--faint); border-radius: 10px; padding: 1rem 1.1rem;
  margin: 1rem 0; }
.grid { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 330px), 1fr)); gap: .8rem 1.2rem;
  align-items: start; margin: .6rem 0; }
figure { margin: 0; min-width: 0; max-width: 27rem; } figure[data-clock] { max-width: 40rem; }
figure.wide { grid-column: 1 / -1; width: 100%; }
figure svg { display: block; width: 100%; height: auto; }
figure.wide svg text { paint-order: stroke; stroke: var(--paper); stroke-width: .22em; stroke-linejoin: round; }
.column { display: grid; gap: .8rem; min-width: 0; align-content: start; }
figure > svg { cursor: zoom-in; }
.live > svg { display: none; }
.chart-head { display: flex; flex-wrap: wrap; justify-content: space-between; gap: 0 .6rem; min-height: 1.7rem; }
.chart-title { font-weight: 600; font-size: .95rem; }
.readout { display: flex; flex-wrap: wrap; gap: 0 .9rem; font-size: .82rem; color: var(--soft); min-height: 1.4em;
  font-variant-numeric: tabular-nums; }
.readout .of { color: var(--line); } .readout output { display: inline-block; min-width: 4.5rem; }
.readout i { display: inline-block; width: 1.1em; margin-right: .35em; border-top: 2px solid; vertical-align: .25em; }
.readout i.dashed { border-top-style: dashed; }
.readout .at { min-width: 5.5rem; margin-left: auto; text-align: right; }
.field { touch-action: pan-y; min-width: 0; } .field:focus-visible { outline: 2px solid var(--model); }
.stretch { font-size: .82rem; color: var(--soft); min-height: 1.4em; font-variant-numeric: tabular-nums; }
.u-select { background: color-mix(in srgb, var(--model) 18%, transparent); }
.u-hz .u-cursor-x, .u-vt .u-cursor-y { border-right: 1px dashed var(--soft); }
.u-hz .u-cursor-y, .u-vt .u-cursor-x { border-bottom: 1px dashed var(--soft); }
.tools { display: inline-flex; gap: .2rem; margin-left: auto; }
button { font: inherit; font-size: .78rem; line-height: 1.3; color: var(--model); background: var(--paper);
  border: 1px solid var(--faint); border-radius: 5px; padding: .1rem .45rem; cursor: pointer; }
.tools .pan { display: none; } .zoomed .pan { display: inline-block; }
figure > .larger { display: block; margin: 0 0 .2rem auto; }
@media (hover: hover) { .larger, .near { opacity: 0; } figure:hover .larger, figure:hover .near, .larger:focus-visible,
  .near:focus-visible { opacity: 1; } }
dialog.enlarged { width: 96vw; max-width: none; height: 96vh; max-height: none; border: 1px solid var(--faint);
  border-radius: 10px; background: var(--paper); color: var(--ink); padding: 1rem 1.2rem; overflow: auto; }
dialog::backdrop { background: rgb(0 0 0 / .55); }
dialog .close { position: sticky; top: 0; float: right; z-index: 2; } dialog .larger { display: none; }
dialog .column { clear: both; } dialog figure { max-width: none !important; clear: both; }
dialog figure > svg { cursor: default; max-height: 84vh; }
figcaption { font-size: .85rem; color: var(--soft); }
.note, .meta { color: var(--soft); font-size: .9rem; }
.lead { font-size: 1.05rem; }
.bad { color: var(--mark); font-weight: 600; }
.good { color: var(--other); font-weight: 600; }
.scroll { overflow-x: auto; max-width: 100%;
  background: linear-gradient(to right, var(--paper) 40%, transparent) 0 0 / 2.5rem 100% no-repeat local,
    linear-gradient(to left, var(--paper) 40%, transparent) 100% 0 / 2.5rem 100% no-repeat local,
    linear-gradient(to right, var(--faint), transparent) 0 0 / .9rem 100% no-repeat scroll,
    linear-gradient(to left, var(--faint), transparent) 100% 0 / .9rem 100% no-repeat scroll; }
table { border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .9rem .28rem 0; text-align: right; vertical-align: top; border-bottom: 1px solid var(--faint);
  overflow-wrap: normal; }
th { color: var(--soft); font-weight: 600; white-space: nowrap; }
td.r { white-space: nowrap; }
th.l, td.l { text-align: left; }
dl { margin: .3rem 0; font-size: .92rem; }
dl div { display: grid; grid-template-columns: minmax(6rem, 13rem) 1fr; gap: .8rem; padding: .18rem 0;
  border-bottom: 1px solid var(--faint); }
dt { color: var(--soft); }
dd { margin: 0; min-width: 0; }
pre { font: .82rem/1.45 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; white-space: pre-wrap;
  margin: .5rem 0; }
summary { cursor: pointer; color: var(--model); padding: .2rem 0; }
ul { margin: .3rem 0; padding-left: 1.2rem; }
@media (max-width: 1000px) { .lead { grid-template-columns: 1fr; } }
@media (max-width: 480px) { nav { flex-wrap: nowrap; overflow-x: auto; white-space: nowrap; scrollbar-width: thin; }
  main { padding: 1rem .6rem 2rem; } section { padding: .8rem .7rem; border-radius: 8px; }
  dl div { grid-template-columns: 1fr; gap: 0; } h2 { font-size: 1.3rem; }
  table { font-size: .8rem; } th, td { padding-right: .55rem; } th { white-space: normal; } td.l { min-width: 3em; }
  table.wide, .wide tbody, .wide tr { display: block; } .wide thead { display: none; }
  .wide tr { border-bottom: 1px solid var(--faint); padding: .35rem 0; font-size: .9rem; }
  .wide td { display: flex; justify-content: space-between; gap: 1rem; border: 0; padding: .05rem 0; min-width: 0;
    text-align: right; white-space: normal; overflow-wrap: anywhere; } .wide td:empty { display: none; }
  .wide td::before { flex: none; max-width: 50%; content: attr(data-label); color: var(--soft); text-align: left; }
  .wide td:first-child { font-weight: 600; } .wide td:first-child::before { font-weight: 400; } }
@page { margin: 15mm 14mm; }
@media print { .chart, button, dialog, nav { display: none !important; } .live > svg { display: block; }
  :root { color-scheme: light; --ink: #000000; --soft: #444444; --faint: #bbbbbb; --paper: #ffffff;
  --ground: #ffffff; --model: #0b6cab; --mark: #b84a00; --other: #0b7558; }
  body { font-size: 10.5pt; } main { padding: 0; max-width: none; } section { border: 0; padding: 0; margin: 1rem 0; }
  .lead, .findings { display: block; margin: 0; } .lead section, .findings section { margin: 1rem 0; }
  p, figure, .column, tr, dl div, ul, .scroll:not(:has(tr:nth-child(13))) { break-inside: avoid; }
  details ul { break-inside: auto; }
  h1, h2, h3, h4, summary, p:has(+ .grid), p:has(+ .scroll) { break-after: avoid; }
  thead { display: table-header-group; }
  .grid { display: block; orphans: 1; widows: 1; } .column { display: inline-block; }
  .grid > * { display: inline-block; width: 48%; margin: 0 1% .6rem 0; vertical-align: top; }
  .grid > .wide { width: 100%; } .column figure { margin-bottom: .4rem; }
  .scroll { overflow: visible; background: none; }
  table { font-size: 8.5pt; } th, td.r { white-space: normal; } th, td { padding-right: .5rem; }
  details::details-content { content-visibility: visible; display: block; } }
"""
