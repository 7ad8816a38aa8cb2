// What the page does by itself: it notices that the program does not answer, and that STOP failed.
const LOOK = 200  // ms from one look at the clock to the next
const SILENT = 1300  // ms without a pulse, which comes four times a second, after which the page is off
const AGAIN = 1000  // ms from one attempt to connect to the next
const STOP_BY_HAND = "Use the emergency switch, or cut the power of the stage."
const shown = id => document.getElementById(id)
const stoppable = shown("stop") !== null

let pulsed = performance.now()  // when the program was last heard
let silence = 0  // ms, of which the page itself was held up in none
let looked = pulsed

function pulse() {
  [pulsed, silence] = [performance.now(), 0]
  look()
}

function look() {
  const now = performance.now()
  silence += Math.min(now - looked, 2 * LOOK)
  looked = now
  const lost = silence > SILENT
  for (const part of [shown("head"), shown("body")]) part.inert = lost
  const banner = shown("lost")
  banner.hidden = !lost
  if (!lost) return
  const age = Math.round((now - pulsed) / 1000)
  const rig = stoppable ? ` The stage may still move: press STOP; if that fails, ${STOP_BY_HAND.toLowerCase()}` : ""
  const text = `The program does not answer. What is shown is ${age} s old.${rig}`
  if (banner.textContent !== text) banner.textContent = text
}

document.addEventListener("stop-asked", event => {
  const banner = shown("unstopped")
  banner.textContent = event.detail ? `STOP failed: ${event.detail}. ${STOP_BY_HAND}` : ""
  banner.hidden = !event.detail
})

// Bokeh's connection is that of what is shown, and the program's pulses have one of their own.
let connected = true

function feel() {
  const pulses = new WebSocket(new URL("pulse", location.href).href.replace(/^http/, "ws"))
  pulses.onmessage = () => { if (connected) pulse() }
  pulses.onclose = () => setTimeout(feel, AGAIN)
}

function listen() {
  const page = globalThis.Bokeh?.documents?.[0]
  if (!page) return void setTimeout(listen, 50)
  page.config.notify_connection_status = false  // the banner tells more
  page.on_event("connection_lost", () => [connected, silence] = [false, 2 * SILENT])
  page.on_event("client_reconnected", () => connected = true)
  pulse()
  feel()
  setInterval(look, LOOK)
  page.on_change(() => {
    clearTimeout(dressing)
    dressing = setTimeout(() => dressNew(page), 30)
  })
  dark.addEventListener("change", () => dress(page.all_models))
  dressNew(page)
  takeDrops([...page.all_models].find(model => model.tags?.includes("dropped")))
}

// What came to the page since the last look has its colours and names set.
const dark = matchMedia("(prefers-color-scheme: dark)")
const dressed = new WeakSet()
let dressing = 0

function dressNew(page) {
  const added = [...page.all_models].filter(model => !dressed.has(model))
  for (const model of added) dressed.add(model)
  if (added.length) dress(added)
}

function dress(models) {
  paint(models)
  setTimeout(dressParts, 300)  // when they are on the page
}

// Figures are drawn on canvases, whose colours the style of the page does not reach.
function paint(models) {
  const [ink, line, faint] = dark.matches ? ["#d5dbe2", "#8a96a3", "#2e3742"] : ["#3a434e", "#5c6675", "#e1e4e8"]
  const colours = {
    text_color: ink, label_text_color: ink, title_text_color: ink,
    axis_label_text_color: ink, major_label_text_color: ink,
    axis_line_color: line, major_tick_line_color: line, minor_tick_line_color: line,
    grid_line_color: faint, outline_line_color: faint,
  }
  for (const model of models) {
    const known = ["Axis", "Grid", "Title", "ColorBar", "Legend", "Figure", "Plot"]
    if (!known.some(kind => model.type.endsWith(kind))) continue
    const here = Object.entries(colours).filter(([name]) => name in model.properties)
    model.setv(Object.fromEntries(here), {sync: false})
  }
}

const ARROW = "url('data:image/svg+xml;utf8,<svg viewBox=\"0 0 25 20\" xmlns=\"http://www.w3.org/2000/svg\">"
  + "<path d=\"M 0,0 25,0 12.5,20 Z\" fill=\"%23d5dbe2\"/></svg>')"

function* partsOf(root) {
  for (const part of root.querySelectorAll("*")) {
    yield part
    if (part.shadowRoot) yield* partsOf(part.shadowRoot)
  }
}

// Names for those who cannot see the page, where the widgets have none, and colours that they do not adapt.
function dressParts() {
  for (const part of partsOf(document)) {
    const title = () => part.getRootNode().querySelector("label, .bk-slider-title")?.textContent.trim() ?? ""
    if (part.matches("select:not([size])")) {
      part.style.backgroundImage = dark.matches ? ARROW : ""
    } else if (part.matches(".noUi-target")) {
      part.style.background = dark.matches ? "#3a434e" : ""
    } else if (part.matches(".bk-spin-btn")) {
      part.ariaLabel = `${part.matches(".bk-spin-btn-up") ? "Increase" : "Decrease"} ${title()}`
    } else if (part.matches(".noUi-handle")) {
      const end = part.matches(".noUi-handle-upper") ? ", end" : ""
      part.ariaLabel = title().replace(/:.*/s, "") + end
    } else if (part.matches("input[type=checkbox]")) {
      part.ariaLabel = part.parentNode.textContent.trim()
    } else if (part.matches(".bk-tool-icon")) {
      const button = part.getRootNode().host
      const kind = [...part.classList].map(name => name.match(/^bk-tool-icon-(.*)/)?.[1]).find(name => name)
      button.role = "button"
      button.tabIndex = 0
      button.ariaLabel = kind?.replaceAll("-", " ") ?? "more tools"
    }
  }
}

// A file that is dropped on the page goes to the server, and opens when it has arrived.
function takeDrops(field) {
  if (!field) return
  const root = document.documentElement
  const aside = event => { event.preventDefault(); root.classList.remove("drop") }
  addEventListener("dragover", event => { event.preventDefault(); root.classList.add("drop") })
  addEventListener("dragleave", aside)
  addEventListener("drop", async event => {
    aside(event)
    for (const file of event.dataTransfer.files) {
      const address = new URL(`drop/${encodeURIComponent(file.name)}`, location.href)
      const answer = await fetch(address, {method: "POST", body: file}).catch(() => null)
      if (answer?.ok) field.value = await answer.text()
    }
  })
}

listen()
