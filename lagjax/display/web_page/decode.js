// Numbers travel as [type, base64 of a little-endian array].
const TYPES = {i1: Int8Array, i2: Int16Array, i4: Int32Array, f4: Float32Array, f8: Float64Array};
const decode = ([type, text]) => new TYPES[type](Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
