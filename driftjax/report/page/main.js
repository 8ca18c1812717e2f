// Start what the page holds.

for (const table of document.querySelectorAll("main table")) makeSortable(table);
if (content.diagnosis) showDiagnosis(content.diagnosis);
else showLearn(content);
