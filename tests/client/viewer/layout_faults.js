// What is wrong with the layout of a page as it stands: texts that are cut or leave the window, controls that lie on
// each other. Evaluates to a list of descriptions.
() => {
  const faults = [];
  const name = (one) => `${one.tagName.toLowerCase()}#${one.id} "${(one.innerText || one.ariaLabel || '').trim().slice(0, 40)}"`;
  const seen = (one) => one.checkVisibility({ visibilityProperty: true }) && one.getBoundingClientRect().width > 0;
  const top = document.querySelector('dialog:modal') ?? document.body; // nothing beneath a dialog can be reached
  const all = [...top.querySelectorAll('*')].filter(seen);
  for (const one of all) {
    const texts = [...one.childNodes].filter((node) => node.nodeType === Node.TEXT_NODE && node.data.trim());
    for (const text of texts) {
      const range = document.createRange();
      range.selectNodeContents(text);
      for (const line of range.getClientRects()) {
        if (line.left < -1 || line.right > innerWidth + 1) faults.push(`${name(one)} leaves the window`);
        const box = one.getBoundingClientRect();
        const inline = getComputedStyle(one).display === 'inline';
        if (!inline && (line.right > box.right + 1 || line.left < box.left - 1)) faults.push(`${name(one)} leaves its box`);
      }
    }
  }
  const controls = all.filter((one) => one.matches('button, a, input, select, summary, #hint, #notice:not(:empty), .legend, label'));
  for (const [index, one] of controls.entries()) {
    for (const other of controls.slice(index + 1)) {
      if (one.contains(other) || other.contains(one)) continue;
      const [a, b] = [one.getBoundingClientRect(), other.getBoundingClientRect()];
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      const sameScroller = one.closest('.scans, #panel') === other.closest('.scans, #panel');
      if (across > 1 && down > 1 && sameScroller) faults.push(`${name(one)} lies on ${name(other)}`);
    }
  }
  const main = document.querySelector('main');
  if (document.documentElement.scrollWidth > innerWidth) faults.push('the window scrolls sideways');
  if (main.scrollWidth > main.clientWidth + 1) faults.push('the page scrolls sideways');
  return faults;
}
