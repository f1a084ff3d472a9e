/* The frontier feature table of many robots (core/frontier.py says what it means).
 *
 * Plain C99, no dependency but the standard library; one call is one thread's share of robots.
 * Two searches give the same table: on small grids label sets spread over a whole grid at a time
 * in byte operations that compilers vectorise; on large ones a breadth-first queue visits every
 * cell once. Seeded in the order of the directions, the queue meets every cell first from the
 * lowest direction, which is the rule for ties.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { UNKNOWN = -1, FREE = 0, OCCUPIED = 1 };
enum { RAW = 0, RELATIVE = 1, PROXIMITY = 2, ABSOLUTE = 3 };
enum { DIRECTIONS = 8, FEATURES = 3 };

static const int STEP_ROW[DIRECTIONS] = {-1, -1, 0, 1, 1, 1, 0, -1};
static const int STEP_COLUMN[DIRECTIONS] = {0, 1, 1, 1, 0, -1, -1, -1};

/* Above this many cells, visiting each once beats spreading over all of them level by level. */
static const int64_t SPREAD_CELLS = 1024;

typedef struct {
    int64_t number, total, squares;
} Moments;

/* A grid with a closed border: H + 2 rows of W + 1 cells, so that the left neighbour of a row's
 * first cell is the border cell at the end of the row above. Every array has a row and a block of
 * slack on both sides, so that whole blocks can be worked on, which compilers turn into one
 * instruction each. */
enum { BLOCK = 16 };

typedef struct {
    int64_t height, width, stride, size;
    int8_t *map;       /* cell codes; the border is occupied */
    uint8_t *fresh;    /* 255 where a path may go on, 0 where it may not or has been */
    uint8_t *passable; /* 255 where a diagonal beside the cell is not blocked by it */
    uint8_t *frontier; /* 255 at frontiers */
    uint8_t *labels;   /* set of first moves that reach the cell, one bit per direction */
    uint8_t *distance; /* length of those paths, spreading only */
    uint8_t *front, *sideways, *upright;
    int32_t *queue, *length; /* searching by queue only */
} Grid;

static int64_t align(int64_t bytes) { return (bytes + 63) & ~(int64_t)63; }

/* All of a grid's arrays in one block; NULL if there is no memory. */
static uint8_t *allocate(Grid *grid, int64_t height, int64_t width) {
    grid->height = height;
    grid->width = width;
    grid->stride = width + 1;
    grid->size = (height + 2) * grid->stride + 1;
    const int64_t slack = align(grid->stride + BLOCK);
    const int64_t bytes = align(grid->size) + 2 * slack, cells = align(4 * grid->size);
    uint8_t *memory = calloc(1, 9 * bytes + 2 * cells);
    if (memory == NULL)
        return NULL;
    uint8_t **arrays[] = {&grid->fresh,    &grid->passable, &grid->frontier, &grid->labels,
                          &grid->distance, &grid->front,    &grid->sideways, &grid->upright};
    for (int i = 0; i < 8; i++)
        *arrays[i] = memory + i * bytes + slack;
    grid->map = (int8_t *)memory + 8 * bytes + slack;
    memset(grid->map - slack, OCCUPIED, bytes);
    grid->queue = (int32_t *)(memory + 9 * bytes);
    grid->length = (int32_t *)(memory + 9 * bytes + cells);
    return memory;
}

static int64_t cell_at(const Grid *grid, int64_t row, int64_t column) {
    return (row + 1) * grid->stride + column + 1;
}

/* Byte masks of a padded map of `size` cells. */
static void mask_cells(const int8_t *restrict map, uint8_t *restrict fresh,
                       uint8_t *restrict passable, uint8_t *restrict frontier, int64_t size,
                       int64_t stride) {
    for (int64_t b = 0; b < size; b += BLOCK)
        for (int64_t i = b; i < b + BLOCK; i++) {
            /* of the codes only UNKNOWN, -1, has the sign bit */
            const int8_t beside = map[i - 1] | map[i + 1] | map[i - stride] | map[i + stride];
            const uint8_t free = -(uint8_t)(map[i] == FREE);
            fresh[i] = free;
            passable[i] = -(uint8_t)(map[i] != OCCUPIED);
            frontier[i] = free & -(uint8_t)(beside < 0);
        }
}

static void read_map(const Grid *grid, const int8_t *map) {
    for (int64_t row = 0; row < grid->height; row++)
        memcpy(grid->map + cell_at(grid, row, 0), map + row * grid->width, grid->width);
    mask_cells(grid->map, grid->fresh, grid->passable, grid->frontier, grid->size, grid->stride);
}

/* Whether one step from a cell is open: to a free cell, and not between two occupied ones. */
static int open_step(const Grid *grid, int64_t cell, int direction) {
    const int64_t row = STEP_ROW[direction] * grid->stride, column = STEP_COLUMN[direction];
    return grid->fresh[cell + row + column] &&
           (grid->passable[cell + row] | grid->passable[cell + column]);
}

static void count(Moments *moments, int64_t *longest, uint8_t labels, int64_t length) {
    int direction = 0;
    while (!(labels >> direction & 1))
        direction++;
    moments[direction].number += 1;
    moments[direction].total += length;
    moments[direction].squares += length * length;
    if (length > *longest)
        *longest = length;
}

/* A diagonal step is two straight half steps: first to the side, on passable cells ... */
static void half_step(const uint8_t *restrict front, const uint8_t *restrict passable,
                      uint8_t *restrict sideways, uint8_t *restrict upright, int64_t first,
                      int64_t last, int64_t stride) {
    for (int64_t b = first; b < last; b += BLOCK)
        for (int64_t i = b; i < b + BLOCK; i++) {
            sideways[i] = (front[i - 1] | front[i] | front[i + 1]) & passable[i];
            upright[i] = (front[i - stride] | front[i + stride]) & passable[i];
        }
}

/* ... then on to fresh cells, which become the front and are closed; returns 0 if there are none. */
static int other_half(const uint8_t *restrict sideways, const uint8_t *restrict upright,
                      uint8_t *restrict fresh, uint8_t *restrict front, uint8_t *restrict labels,
                      uint8_t *restrict distance, uint8_t level, int64_t first, int64_t last,
                      int64_t stride) {
    uint8_t any[BLOCK] = {0};
    for (int64_t b = first; b < last; b += BLOCK)
        for (int64_t k = 0; k < BLOCK; k++) {
            const int64_t i = b + k;
            const uint8_t reached = (sideways[i - stride] | sideways[i] | sideways[i + stride] |
                                     upright[i - 1] | upright[i + 1]) &
                                    fresh[i];
            const uint8_t new = -(uint8_t)(reached != 0);
            front[i] = reached;
            labels[i] |= reached;
            distance[i] |= level & new;
            fresh[i] &= ~new;
            any[k] |= reached;
        }
    uint64_t words[BLOCK / 8];
    memcpy(words, any, sizeof words);
    return (words[0] | words[1]) != 0;
}

/* The paths to all frontiers that have a label. */
static void count_all(const Grid *grid, Moments *moments, int64_t *longest) {
    for (int64_t b = grid->stride; b < grid->size; b += 8) {
        uint64_t labels, frontiers;
        memcpy(&labels, grid->labels + b, 8);
        memcpy(&frontiers, grid->frontier + b, 8);
        if (labels & frontiers) /* few words hold any */
            for (int64_t i = b; i < b + 8; i++)
                if (grid->labels[i] & grid->frontier[i])
                    count(moments, longest, grid->labels[i], grid->distance[i]);
    }
}

/* Label sets spread level by level; returns 0 if a path is longer than a byte can count. */
static int spread(const Grid *grid, int64_t start, Moments *moments, int64_t *longest) {
    const int64_t stride = grid->stride, height = grid->height;
    uint8_t *cleared[] = {grid->labels, grid->front, grid->sideways, grid->upright, grid->distance};
    for (int i = 0; i < 5; i++)
        memset(cleared[i], 0, grid->size + BLOCK);
    for (int d = 0; d < DIRECTIONS; d++) {
        const int64_t next = start + STEP_ROW[d] * stride + STEP_COLUMN[d];
        if (open_step(grid, start, d)) {
            grid->front[next] = grid->labels[next] = (uint8_t)(1 << d);
            grid->distance[next] = 1;
        }
    }
    grid->fresh[start] = 0;
    for (int d = 0; d < DIRECTIONS; d++) /* blocked diagonals stay fresh: a detour may lead there */
        grid->fresh[start + STEP_ROW[d] * stride + STEP_COLUMN[d]] &=
            -(uint8_t)(grid->front[start + STEP_ROW[d] * stride + STEP_COLUMN[d]] == 0);
    for (int level = 2; level < 256; level++) {
        /* only rows that the front can come to are looked at */
        int64_t low = start / stride - level, high = start / stride + level + 1;
        low = low < 1 ? 1 : low;
        high = high > height ? height + 1 : high;
        half_step(grid->front, grid->passable, grid->sideways, grid->upright, low * stride,
                  high * stride, stride);
        if (!other_half(grid->sideways, grid->upright, grid->fresh, grid->front, grid->labels,
                        grid->distance, (uint8_t)level, low * stride, high * stride, stride)) {
            count_all(grid, moments, longest);
            return 1;
        }
    }
    return 0;
}

/* Breadth-first search; every cell keeps the label of the neighbour that found it first. */
static void search(const Grid *grid, int64_t start, Moments *moments, int64_t *longest) {
    int32_t *queue = grid->queue, *length = grid->length;
    int64_t head = 0, tail = 0;
    grid->fresh[start] = 0;
    for (int d = 0; d < DIRECTIONS; d++) {
        const int64_t next = start + STEP_ROW[d] * grid->stride + STEP_COLUMN[d];
        if (!open_step(grid, start, d))
            continue;
        grid->labels[next] = (uint8_t)(1 << d);
        length[next] = 1;
        queue[tail++] = (int32_t)next;
    }
    for (int64_t i = 0; i < tail; i++)
        grid->fresh[queue[i]] = 0;
    while (head < tail) {
        const int64_t cell = queue[head++];
        if (grid->frontier[cell])
            count(moments, longest, grid->labels[cell], length[cell]);
        for (int d = 0; d < DIRECTIONS; d++) {
            if (!open_step(grid, cell, d))
                continue;
            const int64_t next = cell + STEP_ROW[d] * grid->stride + STEP_COLUMN[d];
            grid->fresh[next] = 0;
            grid->labels[next] = grid->labels[cell];
            length[next] = length[cell] + 1;
            queue[tail++] = (int32_t)next;
        }
    }
}

/* The same operations in the same order as core/frontier.py: the results agree to the last bit. */
static void write_table(const Moments *moments, int64_t longest, int mode, int64_t height,
                        int64_t width, float *table) {
    double sum = 0, nearest = INFINITY;
    const double scale = longest > 1 ? (double)longest : 1.0;
    for (int d = 0; d < DIRECTIONS; d++) {
        const double mean = (double)moments[d].total / (double)moments[d].number;
        sum += (double)moments[d].number;
        if (moments[d].number > 0 && mean < nearest)
            nearest = mean;
    }
    if (sum < 1)
        sum = 1;
    for (int d = 0; d < DIRECTIONS; d++, table += FEATURES) {
        const double number = (double)moments[d].number, total = (double)moments[d].total;
        if (moments[d].number == 0) {
            table[0] = table[1] = table[2] = 0.0f;
            continue;
        }
        const double mean = total / number;
        const double spread_of = number * (double)moments[d].squares - total * total;
        const double deviation = sqrt(spread_of) / number;
        if (mode == RELATIVE || mode == PROXIMITY) {
            table[0] = (float)(number / sum);
            table[1] = (float)(mode == RELATIVE ? mean / scale : nearest / mean);
            table[2] = (float)(deviation / scale);
        } else if (mode == ABSOLUTE) {
            table[0] = (float)(number / (double)(height * width));
            table[1] = (float)(mean / (double)(height + width));
            table[2] = (float)(deviation / (double)(height + width));
        } else {
            table[0] = (float)number;
            table[1] = (float)mean;
            table[2] = (float)deviation;
        }
    }
}

/* maps int8 [robots, height, width], positions int64 [robots, 2], tables float [robots, 8, 3];
 * mode one of RAW, RELATIVE, PROXIMITY, ABSOLUTE.
 * Returns 0, 1 when memory is out, or 2 when a position is outside its map. */
int marl_explore_frontier_tables(const int8_t *maps, const int64_t *positions, int64_t robots,
                                 int64_t height, int64_t width, int mode, float *tables) {
    Grid grid;
    uint8_t *memory = allocate(&grid, height, width);
    if (memory == NULL)
        return 1;
    for (int64_t robot = 0; robot < robots; robot++) {
        const int8_t *map = maps + robot * height * width;
        const int64_t row = positions[2 * robot], column = positions[2 * robot + 1];
        if (row < 0 || row >= height || column < 0 || column >= width) {
            free(memory);
            return 2;
        }
        const int64_t start = cell_at(&grid, row, column);
        Moments moments[DIRECTIONS];
        int64_t longest = 0;
        memset(moments, 0, sizeof moments);
        read_map(&grid, map);
        if (height * width > SPREAD_CELLS || !spread(&grid, start, moments, &longest)) {
            read_map(&grid, map); /* a search that gave up has left its marks */
            memset(grid.labels, 0, grid.size);
            search(&grid, start, moments, &longest);
        }
        write_table(moments, longest, mode, height, width, tables + robot * DIRECTIONS * FEATURES);
    }
    free(memory);
    return 0;
}
