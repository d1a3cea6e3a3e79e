// Unpacks zlib data (RFC 1950, 1951) of a known length: at once, and in browsers that cannot do so themselves.
const LENGTH_BASE = [3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258];
const LENGTH_MORE = [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0];
const AWAY_BASE = [1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577];
const LENGTH_ORDER = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];

// All bit patterns of the longest code's length -> length << 16 | symbol.
function huffmanTable(lengths) {
  const wide = Math.max(1, ...lengths), table = new Uint32Array(1 << wide);
  let code = 0;
  for (let length = 1; length <= wide; length++, code <<= 1) {
    lengths.forEach((own, symbol) => {
      if (own !== length) return;
      let turned = 0;
      for (let bit = 0; bit < length; bit++) turned |= (code >> bit & 1) << length - 1 - bit;
      for (let at = turned; at < table.length; at += 1 << length) table[at] = length << 16 | symbol;
      code++;
    });
  }
  return { table, wide };
}

function inflate(source, size) {
  const out = new Uint8Array(size);
  let at = 0, next = 2, held = 0, bits = 0;
  const need = count => { while (bits < count) { held |= source[next++] << bits; bits += 8; } };
  const take = count => { need(count); const value = held & (1 << count) - 1; held >>>= count; bits -= count; return value; };
  const symbol = ({ table, wide }) => { need(wide); const found = table[held & (1 << wide) - 1]; held >>>= found >> 16; bits -= found >> 16; return found & 0xffff; };
  const stored = () => {
    next -= bits >> 3;
    held = bits = 0;
    const length = source[next] | source[next + 1] << 8;
    out.set(source.subarray(next + 4, next + 4 + length), at);
    next += 4 + length;
    at += length;
  };
  const written = () => {
    const literals = take(5) + 257, distances = take(5) + 1, own = new Array(19).fill(0), lengths = [];
    for (let k = take(4) + 4, i = 0; i < k; i++) own[LENGTH_ORDER[i]] = take(3);
    const code = huffmanTable(own);
    while (lengths.length < literals + distances) {
      const s = symbol(code), [value, times] = s < 16 ? [s, 1] : s === 16 ? [lengths.at(-1), 3 + take(2)] : [0, s === 17 ? 3 + take(3) : 11 + take(7)];
      for (let i = 0; i < times; i++) lengths.push(value);
    }
    return [huffmanTable(lengths.slice(0, literals)), huffmanTable(lengths.slice(literals))];
  };
  const agreed = () => [huffmanTable(Array.from({ length: 288 }, (_, s) => s < 144 ? 8 : s < 256 ? 9 : s < 280 ? 7 : 8)), huffmanTable(new Array(30).fill(5))];
  for (let last = 0; !last;) {
    last = take(1);
    const kind = take(2);
    if (kind === 0) { stored(); continue; }
    const [literals, distances] = kind === 1 ? agreed() : written();
    for (let s = symbol(literals); s !== 256; s = symbol(literals)) {
      if (s < 256) { out[at++] = s; continue; }
      const length = LENGTH_BASE[s - 257] + take(LENGTH_MORE[s - 257]), d = symbol(distances);
      const away = AWAY_BASE[d] + take(d < 2 ? 0 : (d >> 1) - 1);
      for (const end = at + length; at < end; at++) out[at] = out[at - away];
    }
  }
  return out;
}
