// Text in cells of the 5x7 dot font. Needs `text`: GLYPH_WORDS a cell, columns of a byte each, the topmost dot lowest.
#ifndef TEXT_GLSL
#define TEXT_GLSL

// Whether a dot of the text lies at a place, in cells from the upper left.
float text_dot(vec2 at, uvec2 cells) {
    if (any(lessThan(at, vec2(0.0))) || any(greaterThanEqual(at, vec2(cells)))) return 0.0;
    uvec2 cell = uvec2(at), dot_at = uvec2(fract(at) * vec2(GLYPH_CELL_DOTS));
    if (any(greaterThanEqual(dot_at, GLYPH_DOTS))) return 0.0;
    uint word = text[(cell.y * cells.x + cell.x) * GLYPH_WORDS + dot_at.x / 4];
    return float(word >> (dot_at.x % 4 * 8 + dot_at.y) & 1);
}

// How much of a pixel is covered by dots. They are about as large: nine lookups spread over it, `third` of a pixel apart,
// keep them from flickering.
float text_coverage(vec2 at, vec2 third, uvec2 cells) {
    float share = 0.0;
    for (int i = 0; i < 9; i++) share += text_dot(at + third * vec2(i % 3 - 1, i / 3 - 1), cells) / 9.0;
    return share;
}

#endif
