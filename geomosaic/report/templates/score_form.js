"use strict";
(() => {
  const form = document.getElementById("scores");
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const data = new FormData(form);
    const scores = {};
    for (const key of form.dataset.criteria.split(" ")) {
      scores[key] = Number(data.get("score-" + key));
    }
    const report = {
      scale: "CCIR 500-1, five levels, 5 is best",
      run: form.dataset.run,
      mosaic: form.dataset.mosaic,
      verdict: form.dataset.grade,
      viewer: String(data.get("viewer")),
      date: new Date().toISOString(),
      scores: scores,
      remark: String(data.get("remark")),
    };
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([JSON.stringify(report, null, 2)], { type: "application/json" }));
    link.download = ["scores", report.run, report.viewer].map((w) => w.replace(/[^\p{L}\p{N}]+/gu, "-")).join("-") + ".json";
    link.click();
    URL.revokeObjectURL(link.href);
    document.getElementById("saved").textContent = "Saved as " + link.download + ".";
  });
})();
