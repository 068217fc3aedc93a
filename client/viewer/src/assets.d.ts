declare module '*.css';

declare module '@cornerstonejs/codec-openjph' {
  export interface FrameInfo {
    width: number;
    height: number;
    componentCount: number;
    bitsPerSample: number;
    isSigned: boolean;
  }
  export interface Decoder {
    getEncodedBuffer(size: number): Uint8Array;
    getDecodedBuffer(): Uint8Array;
    decode(): void;
    getFrameInfo(): FrameInfo;
  }
  export interface OpenJph {
    HTJ2KDecoder: new () => Decoder;
  }
  export interface Options {
    wasmBinary?: ArrayBuffer;
    locateFile?: () => string;
    print: (line: string) => void;
    printErr: (line: string) => void;
  }
  export default function createOpenJph(options: Options): Promise<OpenJph>;
}

declare module '@cornerstonejs/codec-openjph/wasm' {
  const path: string;
  export default path;
}

/** Names of other scripts, which the build writes in. */
declare const WORKER_FILE: string;
declare const MAIN_FILE: string;
declare const ADMIN_FILE: string;
