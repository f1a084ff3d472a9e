/* Where paths lead: first moves and lengths of the shortest ones to listed cells of maps (the reference
 * is `paths_to` of core/frontier.py), and all cells that are reached (`flooded` of core/mapping.py).
 *
 * Plain C99, no dependency but the standard library; one call is one thread's share of searches. A
 * queue visits every cell once, until it has come to all listed cells.
 */
#include "grid.h"

#include <stdlib.h>

/* What is asked of maps. */
typedef struct {
    const int8_t *maps;    /* [num_maps, height, width] */
    const int64_t *cells;  /* [num_maps, num_cells], row * width + column; where to */
    const int64_t *which;  /* [queries], a map */
    const int64_t *starts; /* [queries], a cell */
    int64_t *moves;        /* [queries, num_cells], directions, 0 without a path */
    int64_t *lengths;      /* [queries, num_cells], 0 without a path */
    int64_t num_maps, height, width, num_cells;
} Queries;

/* Work space of one thread: grids with a border (grid.h). */
typedef struct {
    int64_t stride, cells;
    int32_t *queue;
    int32_t *length; /* moves to the cell */
    uint8_t *move;   /* first of them */
    uint8_t *fresh;  /* free cells that no path has come to, 1 or 0 */
    int8_t *code;   /* UNKNOWN, FREE or OCCUPIED; the border is occupied */
    uint8_t *listed; /* 1 or 0 */
} Space;

static void *allocate(Space *space, int64_t height, int64_t width) {
    const int64_t cells = bordered_cells(height, width);
    int32_t *memory = malloc(cells * (2 * sizeof(int32_t) + 4));
    if (memory == NULL)
        return NULL;
    *space = (Space){.stride = width + 1, .cells = cells, .queue = memory};
    space->length = memory + cells;
    space->move = (uint8_t *)(space->length + cells);
    space->fresh = space->move + cells;
    space->code = (int8_t *)space->fresh + cells;
    space->listed = (uint8_t *)space->code + cells;
    return memory;
}

static int64_t bordered(const Space *space, int64_t cell) {
    return cell + space->stride + 1 + cell / (space->stride - 1);
}

static void read_map(Space *space, const int8_t *map, int64_t height, int64_t width) {
    memset(space->code, OCCUPIED, space->cells);
    copy_inside(space->code, map, height, width);
}

/* Seeded in the order of the directions, a first-in-first-out queue comes to every cell first from
 * the lowest direction, which is the rule for ties. */
static void search(Space *space, int64_t start, int64_t left) {
    const int64_t stride = space->stride;
    const int8_t *code = space->code;
    int64_t head = 0, tail = 0;
    for (int64_t cell = 0; cell < space->cells; cell++)
        space->fresh[cell] = code[cell] == FREE;
    memset(space->length, 0, space->cells * sizeof *space->length);
    memset(space->move, 0, space->cells);
    space->fresh[start] = 0;
    left -= space->listed[start];
    space->queue[tail++] = (int32_t)start;
    while (head < tail && left > 0) {
        const int64_t cell = space->queue[head++];
        for (int d = 0; d < DIRECTIONS; d++) {
            const int64_t row = STEP_ROW[d] * stride, column = STEP_COLUMN[d];
            const int64_t next = cell + row + column;
            if (!space->fresh[next] ||
                (d % 2 && code[cell + row] == OCCUPIED && code[cell + column] == OCCUPIED))
                continue;
            space->fresh[next] = 0;
            space->move[next] = cell == start ? (uint8_t)d : space->move[cell];
            space->length[next] = space->length[cell] + 1;
            space->queue[tail++] = (int32_t)next;
            left -= space->listed[next];
        }
    }
}

static int answer(Space *space, const Queries *queries, int64_t query) {
    const int64_t which = queries->which[query], start = queries->starts[query];
    const int64_t inside = queries->height * queries->width, number = queries->num_cells;
    if (which < 0 || which >= queries->num_maps)
        return NO_SUCH;
    if (start < 0 || start >= inside)
        return OUTSIDE;
    const int64_t *cells = queries->cells + which * number;
    read_map(space, queries->maps + which * inside, queries->height, queries->width);
    memset(space->listed, 0, space->cells);
    int64_t left = 0;
    for (int64_t i = 0; i < number; i++) {
        if (cells[i] < 0 || cells[i] >= inside)
            return OUTSIDE;
        uint8_t *listed = space->listed + bordered(space, cells[i]);
        left += !*listed;
        *listed = 1;
    }
    search(space, bordered(space, start), left);
    for (int64_t i = 0; i < number; i++) {
        const int64_t cell = bordered(space, cells[i]);
        queries->moves[query * number + i] = space->move[cell];
        queries->lengths[query * number + i] = space->length[cell];
    }
    return DONE;
}

/* Answers queries `first` to `last` - 1. Returns 0, 1 when memory is out, 2 when a cell is outside
 * its map, or 4 when there is no such map. */
int marl_explore_paths(const Queries *queries, int64_t first, int64_t last) {
    Space space;
    void *memory = allocate(&space, queries->height, queries->width);
    int failed = memory == NULL ? NO_MEMORY : DONE;
    for (int64_t query = first; query < last && !failed; query++)
        failed = answer(&space, queries, query);
    free(memory);
    return failed;
}

/* Grids whose reached cells are asked, one byte a cell, 1 or 0. */
typedef struct {
    const uint8_t *starts;   /* [grids, height, width] */
    const uint8_t *open;     /* the same; cells that paths may enter */
    const uint8_t *passable; /* the same; two other cells close the diagonal between them */
    uint8_t *reached;        /* the same, written */
    int64_t height, width;
} Floods;

/* The same with a border, which no path enters and which closes diagonals. */
typedef struct {
    int32_t *queue;
    int8_t *fresh; /* open cells that no path has come to */
    int8_t *passable;
} Pool;

static void flood(const Pool *pool, int64_t stride, int64_t tail) {
    for (int64_t head = 0; head < tail; head++) {
        const int64_t cell = pool->queue[head];
        for (int d = 0; d < DIRECTIONS; d++) {
            const int64_t row = STEP_ROW[d] * stride, column = STEP_COLUMN[d];
            const int64_t next = cell + row + column;
            if (!pool->fresh[next] ||
                (d % 2 && !pool->passable[cell + row] && !pool->passable[cell + column]))
                continue;
            pool->fresh[next] = 0;
            pool->queue[tail++] = (int32_t)next;
        }
    }
}

static void flood_grid(const Pool *pool, const Floods *floods, int64_t grid) {
    const int64_t height = floods->height, width = floods->width, inside = height * width;
    const uint8_t *open = floods->open + grid * inside, *starts = floods->starts + grid * inside;
    uint8_t *reached = floods->reached + grid * inside;
    int64_t tail = 0;
    copy_inside(pool->fresh, (const int8_t *)open, height, width);
    copy_inside(pool->passable, (const int8_t *)floods->passable + grid * inside, height, width);
    for (int64_t cell = 0; cell < inside; cell++)
        if (starts[cell] && open[cell]) {
            const int64_t place = cell + width + 2 + cell / width;
            pool->fresh[place] = 0;
            pool->queue[tail++] = (int32_t)place;
        }
    flood(pool, width + 1, tail);
    for (int64_t row = 0; row < height; row++)
        for (int64_t column = 0; column < width; column++) {
            const int64_t cell = row * width + column;
            reached[cell] = open[cell] && !pool->fresh[cell + width + 2 + row];
        }
}

/* Floods grids `first` to `last` - 1. Returns 0, or 1 when memory is out. */
int marl_explore_floods(const Floods *floods, int64_t first, int64_t last) {
    const int64_t cells = bordered_cells(floods->height, floods->width);
    int32_t *memory = malloc(cells * (sizeof(int32_t) + 2));
    if (memory == NULL)
        return NO_MEMORY;
    const Pool pool = {memory, (int8_t *)(memory + cells), (int8_t *)(memory + cells) + cells};
    memset(pool.fresh, 0, 2 * cells);
    for (int64_t grid = first; grid < last; grid++)
        flood_grid(&pool, floods, grid);
    free(memory);
    return DONE;
}
