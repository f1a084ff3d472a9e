/* The frontier feature table of many robots (core/frontier.py says what it means).
 *
 * Plain C99, no dependency but the standard library; one call is one thread's share of robots.
 * Two searches give the same table. A breadth-first queue visits every cell once: any grid, any
 * compiler. On small grids, with compilers that know vectors, sets of labels spread over whole rows
 * of cells at a time, which is several times faster.
 */
#include "grid.h"

#include <math.h>
#include <stdlib.h>

enum { RAW = 0, RELATIVE = 1, PROXIMITY = 2, ABSOLUTE = 3 };
enum { FEATURES = 3 };
enum { ALIGNMENT = 64 };

typedef struct {
    int64_t number, total, squares;
} Moments;

typedef struct {
    int64_t height, width;
    const int8_t *end; /* of the maps of all robots */
    void *memory;      /* work space of the search in use */
} Task;

static void count(Moments *moments, int64_t *longest, int direction, int64_t length) {
    moments[direction].number += 1;
    moments[direction].total += length;
    moments[direction].squares += length * length;
    if (length > *longest)
        *longest = length;
}

/* ------------------------------------------------------------------ search by queue */

/* Cells of a grid with a border (grid.h), `stride` a row. */
typedef struct {
    int64_t stride;
    int8_t *code;     /* UNKNOWN, FREE or OCCUPIED; the border is occupied */
    uint8_t *fresh;   /* free cells that no path has come to */
    uint8_t *label;   /* first move of the path to the cell */
    int32_t *length;  /* moves to the cell */
    int32_t *queue;
} Grid;

static int64_t queue_bytes(const Task *task) {
    return 11 * bordered_cells(task->height, task->width);
}

static Grid read_grid(const Task *task, const int8_t *map) {
    const int64_t cells = bordered_cells(task->height, task->width);
    Grid grid = {.stride = task->width + 1, .length = task->memory};
    grid.queue = grid.length + cells;
    grid.code = (int8_t *)(grid.queue + cells);
    grid.fresh = (uint8_t *)grid.code + cells;
    grid.label = grid.fresh + cells;
    memset(grid.code, OCCUPIED, cells);
    copy_inside(grid.code, map, task->height, task->width);
    for (int64_t i = 0; i < cells; i++)
        grid.fresh[i] = grid.code[i] == FREE;
    return grid;
}

/* Of the codes only UNKNOWN, -1, is negative. */
static int is_frontier(const Grid *grid, int64_t cell) {
    const int8_t *code = grid->code + cell;
    return (code[-1] | code[1] | code[-grid->stride] | code[grid->stride]) < 0;
}

/* The cell one step on, if the step is open: to a fresh cell, not between two occupied ones; else 0. */
static int64_t open_step(const Grid *grid, int64_t cell, int direction) {
    const int64_t row = STEP_ROW[direction] * grid->stride, column = STEP_COLUMN[direction];
    const int walled = grid->code[cell + row] == OCCUPIED && grid->code[cell + column] == OCCUPIED;
    return grid->fresh[cell + row + column] && !(row && column && walled) ? cell + row + column : 0;
}

/* Seeded in the order of the directions, a first-in-first-out queue comes to every cell first from
 * the lowest direction, which is the rule for ties. */
static void search(const Task *task, const int8_t *map, int64_t row, int64_t column,
                   Moments *moments, int64_t *longest) {
    const Grid grid = read_grid(task, map);
    const int64_t start = (row + 1) * grid.stride + column + 1;
    int64_t head = 0, tail = 0;
    grid.fresh[start] = 0;
    grid.length[start] = 0;
    grid.queue[tail++] = (int32_t)start;
    while (head < tail) {
        const int64_t cell = grid.queue[head++];
        if (cell != start && is_frontier(&grid, cell))
            count(moments, longest, grid.label[cell], grid.length[cell]);
        for (int d = 0; d < DIRECTIONS; d++) {
            const int64_t next = open_step(&grid, cell, d);
            if (!next)
                continue;
            grid.fresh[next] = 0;
            grid.label[next] = cell == start ? (uint8_t)d : grid.label[cell];
            grid.length[next] = grid.length[cell] + 1;
            grid.queue[tail++] = (int32_t)next;
        }
    }
}

/* -------------------------------------------------------------------- search by rows */

#ifdef __has_builtin
#if __has_builtin(__builtin_shufflevector) && __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__
#define HAS_ROWS 1
#endif
#endif

#ifdef HAS_ROWS

/* A row of the arena is a vector of cells, a byte each, with an empty row above the first and below
 * the last. In rows of two vectors the queue is faster. */
enum { CELLS = 16, MOST_ROWS = 32, LONGEST = 255 };
typedef uint8_t Row __attribute__((vector_size(16)));
typedef Row Rows[MOST_ROWS + 2];

typedef struct {
    Rows fresh;    /* 255 where a path may go on, 0 where it may not or has been */
    Rows passable; /* 255 where a diagonal beside the cell is not blocked by it */
    Rows frontier; /* 255 at frontiers */
    Rows labels;   /* first moves of the paths that have come to the cell, one bit each */
    Rows distance; /* length of those paths */
    Rows unknown;  /* 255 at unknown cells */
} Sheet;

/* OR of the east and west neighbours of all cells of a row. */
static inline Row beside(Row row) {
    const Row none = {0};
    return __builtin_shufflevector(none, row, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28,
                                   29, 30) |
           __builtin_shufflevector(row, none, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16);
}

/* Codes of the cells of a row; beyond its end they are occupied. */
static inline Row load(const Task *task, const int8_t *map, int64_t row) {
    static const uint8_t ramp[2 * CELLS] = {255, 255, 255, 255, 255, 255, 255, 255,
                                            255, 255, 255, 255, 255, 255, 255, 255};
    const int8_t *from = map + row * task->width;
    Row code = {0}, inside;
    memcpy(&code, from, from + CELLS <= task->end ? CELLS : task->end - from);
    memcpy(&inside, ramp + CELLS - task->width, CELLS);
    return (code & inside) | (OCCUPIED & ~inside);
}

/* The level at which `advance` comes to a row so many rows away from the start. */
static inline int64_t first_level(int64_t rows) {
    return rows > 2 ? rows : rows < -2 ? -rows : 2;
}

static inline void read_rows(Sheet *sheet, const Task *task, const int8_t *map, int64_t start_row) {
    const int64_t last = task->height + 1;
    const Row none = {0};
    sheet->unknown[0] = sheet->unknown[last] = none;
    sheet->passable[0] = sheet->passable[last] = none;
    sheet->labels[0] = sheet->labels[last] = none;
    for (int64_t row = 1; row < last; row++) {
        const Row code = load(task, map, row - 1);
        sheet->unknown[row] = (Row)(code == (uint8_t)UNKNOWN);
        sheet->fresh[row] = (Row)(code == FREE);
        sheet->passable[row] = (Row)(code != OCCUPIED);
        sheet->labels[row] = none;
        sheet->distance[row] = none + (uint8_t)first_level(row - 1 - start_row);
    }
    for (int64_t row = 1; row < last; row++)
        sheet->frontier[row] = sheet->fresh[row] & (sheet->unknown[row - 1] | sheet->unknown[row + 1] |
                                                    beside(sheet->unknown[row]));
}

/* Labels of the start's neighbours: one move, and it is their first. */
static inline void seed(Sheet *sheet, const Task *task, int64_t row, int64_t column) {
    const int64_t start = (row + 1) * CELLS + column;
    uint8_t *fresh = (uint8_t *)sheet->fresh, *labels = (uint8_t *)sheet->labels;
    const uint8_t *passable = (uint8_t *)sheet->passable;
    int64_t seeds[DIRECTIONS];
    int number = 0;
    fresh[start] = 0;
    for (int d = 0; d < DIRECTIONS; d++) {
        const int64_t up = STEP_ROW[d] * CELLS, side = STEP_COLUMN[d], next = start + up + side;
        if (row + STEP_ROW[d] < 0 || row + STEP_ROW[d] >= task->height || column + side < 0 ||
            column + side >= task->width)
            continue;
        if (fresh[next] && (passable[start + up] | passable[start + side])) {
            labels[next] = (uint8_t)(1 << d);
            ((uint8_t *)sheet->distance)[next] = 1;
            seeds[number++] = next;
        }
    }
    while (number > 0)
        fresh[seeds[--number]] = 0;
}

/* One step of all paths, rows `first` to `last`; returns whether any of them came to a new cell.
 * All labels spread, not the latest only: cells beside earlier ones are not fresh any more. A diagonal is two straight half steps; one order of them must not cross an occupied cell. */
static inline int advance(Sheet *sheet, int64_t first, int64_t last) {
    const Row *labels = sheet->labels, *passable = sheet->passable;
    Row above = labels[first - 1], here = labels[first]; /* before the step */
    Row half_above = (above | beside(above)) & passable[first - 1]; /* after a half step sideways */
    Row half = (here | beside(here)) & passable[first], any = {0};
    for (int64_t row = first; row <= last; row++) {
        const Row below = labels[row + 1];
        const Row half_below = (below | beside(below)) & passable[row + 1];
        const Row upright = (above | below) & passable[row];
        const Row reached =
            (half_above | half | half_below | beside(upright)) & sheet->fresh[row];
        sheet->labels[row] = here | reached;
        sheet->fresh[row] &= (Row)(reached == 0);
        sheet->distance[row] -= sheet->fresh[row]; /* one more where no path has come */
        any |= reached;
        above = here, here = below;
        half_above = half, half = half_below;
    }
    uint64_t words[2];
    memcpy(words, &any, sizeof words);
    return (words[0] | words[1]) != 0;
}

/* A bit for every byte that is not 0, of 8 bytes that are 0 or 255. */
static inline uint64_t bits(uint64_t bytes) {
    return (bytes & UINT64_C(0x8040201008040201)) * UINT64_C(0x0101010101010101) >> 56;
}

/* The paths to all frontiers that have a label. */
static void count_all(const Sheet *sheet, const Task *task, Moments *moments, int64_t *longest) {
    const uint8_t *labels = (const uint8_t *)(sheet->labels + 1);
    const uint8_t *distance = (const uint8_t *)(sheet->distance + 1);
    uint64_t found[MOST_ROWS / 4] = {0}, sums[DIRECTIONS] = {0}, most = 0;
    for (int64_t row = 0; row < task->height; row++) {
        const Row hit = (Row)((sheet->labels[row + 1] & sheet->frontier[row + 1]) != 0);
        uint64_t words[2];
        memcpy(words, &hit, sizeof words);
        found[row / 4] |= (bits(words[0]) | bits(words[1]) << 8) << row % 4 * 16;
    }
    for (int64_t i = 0; 4 * i < task->height; i++)
        for (uint64_t left = found[i]; left != 0; left &= left - 1) {
            const int64_t cell = 64 * i + __builtin_ctzll(left);
            const uint64_t length = distance[cell];
            /* three sums in one: of 1, of lengths and of their squares, at most 2^9, 2^17, 2^25 */
            sums[__builtin_ctz(labels[cell])] += 1 | length << 16 | length * length << 36;
            most = length > most ? length : most;
        }
    for (int d = 0; d < DIRECTIONS; d++) {
        moments[d].number = sums[d] & 0xffff;
        moments[d].total = sums[d] >> 16 & 0xfffff;
        moments[d].squares = sums[d] >> 36;
    }
    *longest = (int64_t)most;
}

/* Returns 0 if a path is longer than a byte can count. */
static int spread(const Task *task, const int8_t *map, int64_t row, int64_t column,
                  Moments *moments, int64_t *longest) {
    Sheet *sheet = task->memory;
    read_rows(sheet, task, map, row);
    seed(sheet, task, row, column);
    for (int64_t level = 2; level <= LONGEST; level++) {
        /* only rows that paths of this length can come to are looked at */
        const int64_t first = row + 1 - level, last = row + 1 + level;
        if (!advance(sheet, first < 1 ? 1 : first, last > task->height ? task->height : last)) {
            count_all(sheet, task, moments, longest);
            return 1;
        }
    }
    return 0;
}

static int spreads(const Task *task) {
    return task->height <= MOST_ROWS && task->width <= CELLS;
}

static int64_t spread_bytes(void) { return sizeof(Sheet); }

#else

static int spreads(const Task *task) { return (void)task, 0; }

static int spread(const Task *task, const int8_t *map, int64_t row, int64_t column,
                  Moments *moments, int64_t *longest) {
    return (void)task, (void)map, (void)row, (void)column, (void)moments, (void)longest, 0;
}

static int64_t spread_bytes(void) { return 0; }

#endif

/* ------------------------------------------------------------------------- the table */

/* The same operations in the same order as core/frontier.py: the results agree to the last bit. */
static void write_table(const Moments *moments, int64_t longest, int mode, int64_t height,
                        int64_t width, float *table) {
    const double scale = longest > 1 ? (double)longest : 1.0;
    double number[DIRECTIONS], mean[DIRECTIONS], deviation[DIRECTIONS], sum = 0, nearest = INFINITY;
    for (int d = 0; d < DIRECTIONS; d++) { /* without branches, so that it runs in vectors */
        const double some = moments[d].number > 0 ? (double)moments[d].number : 1.0;
        const double total = (double)moments[d].total;
        number[d] = (double)moments[d].number;
        mean[d] = total / some;
        deviation[d] = sqrt(number[d] * (double)moments[d].squares - total * total) / some;
    }
    for (int d = 0; d < DIRECTIONS; d++) {
        sum += number[d];
        if (mean[d] > 0 && mean[d] < nearest)
            nearest = mean[d];
    }
    double of_number = 1, of_length = 1;
    if (mode == ABSOLUTE) {
        of_number = (double)(height * width);
        of_length = (double)(height + width);
    } else if (mode != RAW) {
        of_number = sum > 1 ? sum : 1;
        of_length = scale;
    }
    for (int d = 0; d < DIRECTIONS; d++, table += FEATURES) {
        table[0] = (float)(number[d] / of_number);
        table[1] = (float)(mode != PROXIMITY ? mean[d] / of_length
                           : mean[d] > 0     ? nearest / mean[d]
                                             : 0.0);
        table[2] = (float)(deviation[d] / of_length);
    }
}

/* maps int8 [robots, height, width], positions int64 [robots, 2], tables float [robots, 8, 3];
 * mode one of RAW, RELATIVE, PROXIMITY, ABSOLUTE; `rows` 0 to search by queue only.
 * Returns 0, 1 when memory is out, or 2 when a position is outside its map. */
int marl_explore_frontier_tables(const int8_t *maps, const int64_t *positions, int64_t robots,
                                 int64_t height, int64_t width, int mode, int rows,
                                 float *tables) {
    Task task = {.height = height, .width = width, .end = maps + robots * height * width};
    const int64_t bytes = queue_bytes(&task) > spread_bytes() ? queue_bytes(&task) : spread_bytes();
    rows = rows && spreads(&task);
    uint8_t *memory = malloc(bytes + ALIGNMENT);
    if (memory == NULL)
        return NO_MEMORY;
    task.memory = memory + ALIGNMENT - (uintptr_t)memory % ALIGNMENT;
    int outside = 0;
    for (int64_t robot = 0; robot < robots && !outside; robot++) {
        const int8_t *map = maps + robot * height * width;
        const int64_t row = positions[2 * robot], column = positions[2 * robot + 1];
        Moments moments[DIRECTIONS];
        int64_t longest = 0;
        memset(moments, 0, sizeof moments);
        outside = !is_inside(row, column, height, width);
        if (outside)
            break;
        if (!rows || !spread(&task, map, row, column, moments, &longest))
            search(&task, map, row, column, moments, &longest);
        write_table(moments, longest, mode, height, width, tables + robot * DIRECTIONS * FEATURES);
    }
    free(memory);
    return outside ? OUTSIDE : DONE;
}
