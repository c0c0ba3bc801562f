// Numbers travel as base64 of little-endian arrays.
const decode = (text, Type) => new Type(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
