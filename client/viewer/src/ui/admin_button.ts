import type { Admin } from '../admin/admin.ts';
import { strings } from '../strings.ts';
import { h } from './dom.ts';

/** The way to what only admins see. The script for that is fetched when somebody goes there, and the node asks everybody's role. */
export class AdminButton {
  readonly element = h('button', { type: 'button', class: 'secondary', hidden: true, click: () => void this.open() }, strings.admin.open);
  private admin: Admin | undefined;

  /** Who is connected now, by role; null: nobody. */
  allow(role: string | null): void {
    this.element.hidden = role !== 'admin';
    if (role !== null && role !== 'admin') this.admin?.close();
  }

  private async open(): Promise<void> {
    if (!this.admin) {
      const { Admin } = (await import(new URL(ADMIN_FILE, import.meta.url).href)) as typeof import('../admin/admin.ts');
      this.admin ??= new Admin(strings);
    }
    this.admin.open();
  }
}
