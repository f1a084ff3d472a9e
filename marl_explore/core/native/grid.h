/* What the kernels share: the cells of a map, the eight directions, error codes. */
#ifndef MARL_EXPLORE_GRID_H
#define MARL_EXPLORE_GRID_H

#include <stdint.h>
#include <string.h>

enum { UNKNOWN = -1, FREE = 0, OCCUPIED = 1 };
enum { DIRECTIONS = 8 };
enum { DONE = 0, NO_MEMORY = 1, OUTSIDE = 2, SEEN_OUTSIDE = 3, NO_SUCH = 4 };

static const int STEP_ROW[DIRECTIONS] = {-1, -1, 0, 1, 1, 1, 0, -1};
static const int STEP_COLUMN[DIRECTIONS] = {0, 1, 1, 1, 0, -1, -1, -1};

static inline int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t most(int64_t a, int64_t b) { return a > b ? a : b; }

static inline int is_inside(int64_t row, int64_t column, int64_t height, int64_t width) {
    return row >= 0 && row < height && column >= 0 && column < width;
}

/* Cells of a grid with a border: width + 1 bytes a row, so that the left neighbour of a row's first
 * cell is the border cell at the end of the row above. */
static inline int64_t bordered_cells(int64_t height, int64_t width) {
    return (height + 2) * (width + 1) + 1;
}

/* Copies a map into such a grid; the border stays as it is. */
static inline void copy_inside(int8_t *grid, const int8_t *map, int64_t height, int64_t width) {
    for (int64_t row = 0; row < height; row++)
        memcpy(grid + (row + 1) * (width + 1) + 1, map + row * width, width);
}

#endif
