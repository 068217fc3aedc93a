import { RemoteWireError } from './protocol/errors.ts';

/** RGBA of a JPEG file by the browser's own decoder, colours untouched. */
export async function decodeJpegNatively(file: Uint8Array, width: number, height: number): Promise<Uint8Array> {
  let bitmap: ImageBitmap;
  try {
    const blob = new Blob([file as Uint8Array<ArrayBuffer>], { type: 'image/jpeg' });
    bitmap = await createImageBitmap(blob, { colorSpaceConversion: 'none', premultiplyAlpha: 'none' });
  } catch {
    throw new RemoteWireError('JPEG does not decode');
  }
  if (bitmap.width !== width || bitmap.height !== height) throw new RemoteWireError('JPEG decoded to another size');
  const context = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true })!;
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return new Uint8Array(context.getImageData(0, 0, width, height).data.buffer);
}
