// Affine transforms.
#ifndef ROWS_GLSL
#define ROWS_GLSL

// An affine transform as rows.
struct Rows { vec4 r[AFFINE_ROWS]; };

Rows multiply(Rows a, Rows b) {
    Rows c;
    for (int i = 0; i < AFFINE_ROWS; i++) {
        c.r[i] = a.r[i].x * b.r[0] + a.r[i].y * b.r[1] + a.r[i].z * b.r[2] + vec4(0, 0, 0, a.r[i].w);
    }
    return c;
}

#endif
