// Text of the tiles, from the result message: [value, unit and remarks] each.

const MINUS = "−";
export const fixed = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]*$)/, "").replace("-", MINUS);
export const grouped = (value) => Math.round(value).toLocaleString("en").replaceAll(",", "\u202f");
const NONE = ["–", ""];

export function area({ contact }, unit) {
  if (!contact) return ["–", "no contact"];
  if (unit === "px") return [grouped(contact.area), "px²"];
  return [fixed(contact.area_mm2, 2), `mm² at ${contact.center_mm.map((value) => fixed(value, 1)).join(", ")} mm`];
}

export function angle({ contact }) {
  if (!contact) return NONE;
  if (contact.angle === null) return ["–", "no direction"];
  return [`${fixed(contact.angle, 1)}°`, `confidence ${fixed(contact.confidence, 2)}`];
}

export function flow({ flow }, unit) {
  if (!flow) return NONE;
  if (!flow.mean) return ["–", "no marker inside"];
  const [mean, stderr] = unit === "px" ? [flow.mean, flow.stderr] : [flow.mean_mm, flow.mean_mm_stderr];
  const digits = unit === "px" ? 2 : 3;
  const twist = flow.rotation == null ? "" : `, twist ${fixed(flow.rotation, 1)}°`;
  const count = `${flow.count} ${flow.count === 1 ? "marker" : "markers"}`;
  return [fixed(Math.hypot(...mean), digits), `${unit}${error(lengthError(mean, stderr), digits)}, ${count}${twist}`];
}

export function depth({ contact }) {
  if (contact?.depth_mm == null) return NONE;
  const { depth_mm, depth_mm_stderr, volume_mm3 } = contact;
  return [fixed(depth_mm, 3), `mm${error(depth_mm_stderr, 3)}, ${fixed(volume_mm3, 2)} mm³`];
}

// The normal component is always present; tangential ones depend on the calibration.
export function force({ force }) {
  if (!force) return NONE;
  const { value, stderr, in_range, as_calibrated } = force;
  const along = ["x", "y"].flatMap((axis, i) => (value[i] === null ? [] : [`${axis} ${fixed(value[i], 2)}`]));
  // Outside the range of the calibration, the standard error is invalid.
  const changed = as_calibrated === false ? ", the gel has changed" : "";
  const unit = in_range === false ? "N, outside the fit" : `N${error(stderr[2], 2)}${changed}`;
  return [fixed(value[2], 2), [unit, ...along].join(", ")];
}

export function slip({ slip }) {
  if (!slip) return NONE;
  const { slipping, kind, stick_ratio, translation, translation_mm, rotation } = slip;
  const way = translation_mm ? `${fixed(Math.hypot(...translation_mm), 2)} mm` : `${fixed(Math.hypot(...(translation ?? [0])), 1)} px`;
  const moved = translation ? `, slid ${way}, turned ${fixed(rotation, 1)}°` : "";
  return [slipping ? (kind === "creeping" ? "creeps" : "slips") : "holds", `${Math.round(100 * stick_ratio)}\u202f% of the contact sticks${moved}`];
}

// Its length and largest error along the gel and out of it, and its turn.
export function pose({ pose }) {
  if (!pose) return NONE;
  const { status, translation, rotation, stderr } = pose;
  if (status === "lost") return ["lost", ""];
  const way = `mm${error(Math.max(...stderr.slice(0, 3)), 2)}`;
  const turn = `turned ${fixed(Math.hypot(...rotation), 1)}${error(Math.max(...stderr.slice(3)), 1)}°`;
  return [fixed(Math.hypot(...translation), 2), `${way}, ${turn}`];
}

// Progress of a session: [count, fraction, result of the last press, whether it is good].
export function guide({ done, good, wanted, presses, lasts, noun = "presses", note }) {
  const count = `${done} of ${wanted} ${noun}${good < done ? `, ${good} good` : ""}`;
  const share = Math.min(1, done / wanted);
  if (note !== undefined) return [count, share, note, true];
  const last = presses[presses.length - 1];
  if (!last || lasts) return [count, share, "", true];
  return [count, share, `Press ${done}: ${last.fault ?? "good"}.`, last.fault === null];
}

const error = (stderr, digits) => (stderr == null ? "" : ` ± ${fixed(stderr, digits)}`);

// Standard error of the length of a vector, from those of its components.
function lengthError(vector, stderr) {
  const length = Math.hypot(...vector);
  return stderr && length > 0 ? Math.hypot(...vector.map((part, i) => part * stderr[i])) / length : null;
}
