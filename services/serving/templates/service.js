"use strict";
const at = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";
let token = "", model = null, shown = null;

function element(name, text, parent) {
  const made = document.createElement(name);
  made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

async function ask(method, path, body, type) {
  const headers = { authorization: `Bearer ${token}` };
  if (body !== undefined) headers["content-type"] = type || "application/json";
  const answer = await fetch(path, { method, headers, body });
  if (answer.status === 204) return null;
  const content = await answer.json();
  if (answer.ok) return content;
  const detail = content.detail;
  const lines = Array.isArray(detail) ? detail.map((one) => `${one.loc.join(".")}: ${one.msg}`) : [detail];
  throw new Error(`${answer.status}: ${lines.join("\n")}`);
}

async function doing(what, work) {
  at("problem").textContent = "";
  at("doing").textContent = what;
  try {
    await work();
  } catch (error) {
    at("problem").textContent = error.message;
  } finally {
    at("doing").textContent = "";
  }
}

function onSubmit(id, what, work) {
  at(id).addEventListener("submit", (event) => {
    event.preventDefault();
    doing(what, () => work(event.target.elements));
  });
}

function strip(subSkills, name) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", `0 0 ${subSkills.length} 1`);
  svg.setAttribute("preserveAspectRatio", "none");
  svg.setAttribute("class", "strip");
  svg.setAttribute("role", "img");
  const used = [...new Set(subSkills)].sort((a, b) => a - b);
  const shares = used.map((k) => {
    const steps = subSkills.filter((one) => one === k).length;
    return `sub-skill ${k} in ${Math.round((100 * steps) / subSkills.length)}%`;
  });
  svg.setAttribute("aria-label", `${name}: ${shares.join(", ")} of ${subSkills.length} steps`);
  for (let start = 0, end; start < subSkills.length; start = end) {
    for (end = start; end < subSkills.length && subSkills[end] === subSkills[start]; ) end += 1;
    svg.append(box(start, end - start, subSkills[start]));
  }
  return svg;
}

function box(x, width, subSkill) {
  const rect = document.createElementNS(SVG, "rect");
  for (const [name, value] of Object.entries({ x, y: 0, width, height: 1 })) rect.setAttribute(name, value);
  rect.setAttribute("fill", COLOURS[subSkill % COLOURS.length]);
  return rect;
}

function show(policy) {
  shown = policy.id;
  at("policy").hidden = false;
  at("policy-title").textContent = `Policy ${policy.id}`;
  at("errors").textContent =
    `Error on what was demonstrated: ${policy.error_before.toPrecision(4)} before adaptation, ` +
    `${policy.error_after.toPrecision(4)} after ${policy.steps} steps at ${policy.learning_rate}.`;
  at("warnings").replaceChildren(...policy.warnings.map((one) => element("li", one)));
  at("timelines").replaceChildren(...policy.timelines.map((one, index) => strip(one, `demonstration ${index}`)));
  at("legend").replaceChildren(
    ...Array.from({ length: policy.sub_skills }, (_, k) => {
      const item = element("li", ""), svg = document.createElementNS(SVG, "svg");
      svg.setAttribute("viewBox", "0 0 1 1");
      svg.setAttribute("aria-hidden", "true");
      svg.append(box(0, 1, k));
      item.append(svg, `sub-skill ${k}`);
      return item;
    }),
  );
  at("episode").replaceChildren();
}

async function list() {
  const rows = (await ask("GET", "/v1/policies")).reverse().map((one) => {
    const row = document.createElement("tr");
    const values = [
      one.id.slice(0, 12), one.demonstrations.join(", "), one.steps, one.error_before.toPrecision(4),
      one.error_after.toPrecision(4), new Date(one.expires_at).toLocaleString(),
    ];
    for (const value of values) element("td", value, row);
    const cell = element("td", "", row);
    const open = element("button", "Show", cell), remove = element("button", "Remove", cell);
    open.setAttribute("aria-label", `Show ${one.id}`);
    remove.setAttribute("aria-label", `Remove ${one.id}`);
    open.addEventListener("click", () => doing("", async () => show(await ask("GET", `/v1/policies/${one.id}`))));
    remove.addEventListener("click", () =>
      doing("", async () => {
        await ask("DELETE", `/v1/policies/${one.id}`);
        if (shown === one.id) at("policy").hidden = true;
        await list();
      }),
    );
    return row;
  });
  at("policies").tBodies[0].replaceChildren(...rows);
}

onSubmit("login", "asking for the model ...", async (fields) => {
  token = fields.token.value.trim();
  model = await ask("GET", "/v1/model");
  at("model").textContent =
    `Model ${model.model.slice(0, 12)}: ${model.method}, ${model.trained_on}; ${model.obs_dim} numbers in, ` +
    `${model.action_dim} out, ${model.sub_skills} sub-skills.`;
  at("adapt").elements.steps.placeholder = model.steps;
  at("adapt").elements.rate.placeholder = model.learning_rate;
  at("play").hidden = model.tasks.length === 0;
  at("play").elements.task.replaceChildren(...model.tasks.map((one) => element("option", one)));
  at("login").hidden = true;
  at("opened").hidden = false;
  await list();
});

onSubmit("adapt", "adapting ...", async (fields) => {
  const file = fields.file.files[0], steps = fields.steps.value, rate = fields.rate.value;
  const asJson = file.name.endsWith(".json");
  let body = file, query = new URLSearchParams();
  if (asJson) {
    body = JSON.parse(await file.text());
    if (steps) body.steps = Number(steps);
    if (rate) body.learning_rate = Number(rate);
    body = JSON.stringify(body);
  } else {
    if (steps) query.set("steps", steps);
    if (rate) query.set("learning_rate", rate);
  }
  const type = asJson ? "application/json" : "application/octet-stream";
  show(await ask("POST", `/v1/policies?${query}`, body, type));
  await list();
});

onSubmit("play", "playing ...", async (fields) => {
  const question = { task: fields.task.value, seed: Number(fields.seed.value) };
  const played = await ask("POST", `/v1/policies/${shown}/episodes`, JSON.stringify(question));
  const parts = [element("p", `${played.success ? "solved" : "not solved"} in ${played.steps} steps`)];
  if (played.video) {
    const film = document.createElement("video");
    film.controls = true;
    film.src = `data:video/mp4;base64,${played.video}`;
    film.setAttribute("aria-label", `${question.task}, episode ${question.seed}`);
    parts.push(film);
  }
  if (played.note) parts.push(element("p", played.note));
  parts.push(strip(played.sub_skills, "the episode"));
  at("episode").replaceChildren(...parts);
});
