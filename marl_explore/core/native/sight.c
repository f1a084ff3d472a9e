/* What obstacles leave in sight of the centres of many windows, how many unknown cells robots would
 * see from cells of their maps (core/sight.py is the reference), what is around robots, and what
 * they write into their maps (core/sensing.py).
 *
 * Plain C99, no dependency but the standard library; one call is one thread's share. LANES windows
 * are looked at side by side: each of their cells has a vector with a byte of every window.
 */
#include "world.h"

#include <stdlib.h>

enum { LANES = 16, TILE = LANES * LANES };
enum { UNCOUNTED = 3 }; /* an unknown cell outside a robot's shape */

typedef int8_t Lanes[LANES];

/* Work space of one thread. */
typedef struct {
    int64_t side, cells; /* of a window, and its cells up to a multiple of LANES */
    int8_t *rows;        /* the windows one after another, [LANES, cells] */
    Lanes *code;         /* [cells], FREE, OCCUPIED, UNKNOWN or UNCOUNTED */
    Lanes *seen;         /* [cells], 1 or 0 */
    int8_t *kept;        /* [num_kinds, cells], the bits of a code that count */
} Windows;

/* What is asked of maps; bools are a byte each, 0 or 1. */
typedef struct {
    const int8_t *maps;   /* [num_maps, height, width] */
    const int64_t *which; /* [queries], a map */
    const int64_t *cell;  /* [queries], row * width + column */
    const int64_t *kind;  /* [queries], a mask */
    const uint8_t *masks; /* [num_kinds, side, side], the shapes of sensors */
    int64_t *found;       /* [queries], the answers */
    int64_t num_maps, height, width, num_kinds, side;
    int64_t hides; /* whether obstacles end sight */
} Queries;

/* Returns the memory that the work space lies in, or NULL. */
static void *allocate(Windows *windows, int64_t side, int64_t num_kinds) {
    const int64_t cells = (side * side + LANES - 1) / LANES * LANES;
    int8_t *memory = calloc((3 * LANES + num_kinds) * cells, 1);
    if (memory == NULL)
        return NULL;
    *windows = (Windows){.side = side, .cells = cells, .rows = memory};
    windows->code = (Lanes *)(memory + LANES * cells);
    windows->seen = windows->code + cells;
    windows->kept = (int8_t *)(windows->seen + cells);
    return memory;
}

/* --------------------------------------------------------- from windows to lanes, and back */

static void interleave(const int8_t *restrict from, int8_t *restrict to) {
    for (int i = 0; i < TILE / 2; i++) {
        to[2 * i] = from[i];
        to[2 * i + 1] = from[TILE / 2 + i];
    }
}

/* Interleaving the halves of a square tile as often as its side can be halved transposes it. */
static inline void transpose(const int8_t *from, int8_t *to) {
    int8_t once[TILE], twice[TILE];
    interleave(from, once);
    interleave(once, twice);
    interleave(twice, once);
    interleave(once, to);
}

static void to_lanes(Windows windows) {
    for (int64_t cell = 0; cell < windows.cells; cell += LANES) {
        int8_t tile[TILE];
        for (int i = 0; i < LANES; i++)
            memcpy(tile + i * LANES, windows.rows + i * windows.cells + cell, LANES);
        transpose(tile, windows.code[cell]);
    }
}

static void from_lanes(Windows windows) {
    for (int64_t cell = 0; cell < windows.cells; cell += LANES) {
        int8_t tile[TILE];
        transpose(windows.seen[cell], tile);
        for (int i = 0; i < LANES; i++)
            memcpy(windows.rows + i * windows.cells + cell, tile + i * LANES, LANES);
    }
}

/* ------------------------------------------------------------------------------------- sight */

/* Adds what is seen through a parent: one that is seen and no obstacle, if the step from it does
 * not pass between two obstacles. */
static inline void look_through(Windows windows, int64_t parent, int64_t beside, int64_t other,
                                Lanes seen) {
    const int8_t *code = windows.code[parent], *from = windows.seen[parent];
    const int8_t *left = windows.code[beside], *right = windows.code[other];
    for (int i = 0; i < LANES; i++)
        seen[i] |= from[i] & (code[i] != OCCUPIED) &
                   ((left[i] != OCCUPIED) | (right[i] != OCCUPIED));
}

/* From the inside out. The line from the centre to a cell, `ring` steps out and `off` aside, passes
 * the ring before off / ring of a cell nearer to the middle. Of that ring the cell straight inside
 * is nearest if this is at most a half, and the diagonal one if it is at least a half. */
static void look(Windows windows) {
    const int64_t side = windows.side, centre = side * side / 2;
    const int64_t steps[4] = {-side, 1, side, -1};
    memset(windows.seen[centre], 1, LANES);
    for (int64_t ring = 1; ring <= side / 2; ring++)
        for (int i = 0; i < 4; i++) {
            const int64_t out = steps[i], aside = steps[(i + 1) % 4];
            for (int64_t off = -ring; off < ring; off++) { /* the next side has the other corner */
                const int64_t cell = centre + ring * out + off * aside, straight = cell - out;
                const int64_t inward = off < 0 ? aside : -aside, twice = 2 * (off < 0 ? -off : off);
                Lanes seen = {0};
                if (twice <= ring)
                    look_through(windows, straight, straight, straight, seen);
                if (twice >= ring)
                    look_through(windows, straight + inward, straight, cell + inward, seen);
                memcpy(windows.seen[cell], seen, LANES);
            }
        }
}

/* What is seen from the centres of windows of obstacles, both [number, side, side] with a byte,
 * 0 or 1, per cell; `side` is odd. Returns 0, or 1 when memory is out. */
int marl_explore_line_of_sight(const uint8_t *walls, int64_t number, int64_t side, uint8_t *seen) {
    const int64_t cells = side * side;
    Windows windows;
    void *memory = allocate(&windows, side, 0);
    if (memory == NULL)
        return NO_MEMORY;
    for (int64_t first = 0; first < number; first += LANES) {
        const int64_t lanes = least(LANES, number - first);
        for (int64_t i = 0; i < lanes; i++)
            memcpy(windows.rows + i * windows.cells, walls + (first + i) * cells, cells);
        to_lanes(windows);
        look(windows);
        from_lanes(windows);
        for (int64_t i = 0; i < lanes; i++)
            memcpy(seen + (first + i) * cells, windows.rows + i * windows.cells, cells);
    }
    free(memory);
    return DONE;
}

/* ------------------------------------------------------------------------------- discoveries */

/* Codes keep all their bits in a shape; outside, obstacles stay and unknown cells do not count. */
static void read_masks(Windows windows, const Queries *queries) {
    const int64_t cells = windows.side * windows.side;
    for (int64_t kind = 0; kind < queries->num_kinds; kind++)
        for (int64_t cell = 0; cell < cells; cell++)
            windows.kept[kind * windows.cells + cell] =
                queries->masks[kind * cells + cell] ? UNKNOWN : UNCOUNTED;
}

/* Reads the window around a cell; outside the map it is FREE, which hides and counts nowhere. */
static int read_window(Windows windows, const Queries *queries, int64_t query, int8_t *window) {
    const int64_t height = queries->height, width = queries->width, side = windows.side;
    const int64_t which = queries->which[query], cell = queries->cell[query];
    const int64_t kind = queries->kind[query], radius = side / 2;
    if (which < 0 || which >= queries->num_maps || kind < 0 || kind >= queries->num_kinds)
        return NO_SUCH;
    if (cell < 0 || cell >= height * width)
        return OUTSIDE;
    const int64_t row = cell / width, column = cell % width;
    const int64_t left = most(column - radius, 0), right = least(column + radius, width - 1);
    const int64_t top = most(row - radius, 0), bottom = least(row + radius, height - 1);
    const int8_t *map = queries->maps + which * height * width;
    memset(window, FREE, windows.cells);
    for (int64_t r = top; r <= bottom; r++)
        memcpy(window + (r - row + radius) * side + left - column + radius, map + r * width + left,
               right - left + 1);
    const int8_t *kept = windows.kept + kind * windows.cells;
    for (int64_t i = 0; i < windows.cells; i++)
        window[i] &= kept[i];
    return DONE;
}

static void count(Windows windows, int64_t lanes, int64_t *found) {
    enum { MOST = 255 }; /* that a byte counts */
    memset(found, 0, lanes * sizeof *found);
    for (int64_t first = 0; first < windows.cells; first += MOST) {
        const int64_t last = least(first + MOST, windows.cells);
        uint8_t sum[LANES] = {0};
        for (int64_t cell = first; cell < last; cell++) {
            const int8_t *code = windows.code[cell], *seen = windows.seen[cell];
            for (int i = 0; i < LANES; i++)
                sum[i] += seen[i] & (code[i] == UNKNOWN);
        }
        for (int64_t i = 0; i < lanes; i++)
            found[i] += sum[i];
    }
}

/* Answers queries `first` to `last` - 1: the number of unknown cells of a robot's shape around a
 * cell that it would see if all unknown cells were free; `side` is odd.
 * Returns 0, 1 when memory is out, 2 when a cell is outside its map, or 4 when there is no such map
 * or mask. */
int marl_explore_expected_discoveries(const Queries *queries, int64_t first, int64_t last) {
    Windows windows;
    void *memory = allocate(&windows, queries->side, queries->num_kinds);
    if (memory == NULL)
        return NO_MEMORY;
    read_masks(windows, queries);
    if (!queries->hides)
        memset(windows.seen, 1, windows.cells * LANES);
    int failed = DONE;
    for (; first < last && !failed; first += LANES) {
        const int64_t lanes = least(LANES, last - first);
        for (int64_t i = 0; i < lanes && !failed; i++)
            failed = read_window(windows, queries, first + i, windows.rows + i * windows.cells);
        to_lanes(windows);
        if (queries->hides)
            look(windows);
        count(windows, lanes, queries->found + first);
    }
    free(memory);
    return failed;
}

/* ------------------------------------------------------------------------------- a robot's look */

/* Draws what stands on some cells into the window that begins at `corner`. */
static void draw(const int64_t *cells, int64_t number, int64_t corner, const Looks *looks,
                 int8_t *view) {
    const int64_t side = looks->side, width = looks->width;
    for (int64_t i = 0; i < number; i++) {
        const int64_t off = cells[i] - corner;
        if (off >= 0 && off < side * width && off % width < side)
            view[off / width * side + off % width] = ROBOT;
    }
}

/* Copies the window around robot `robot`; its own cell is OPEN. */
static int copy_window(const Looks *looks, int64_t robot, int8_t *view) {
    const int64_t side = looks->side, width = looks->width, own = looks->own[robot];
    const int64_t corner = own - side / 2 * (width + 1), arena = robot / looks->team;
    if (corner < 0 || corner + (side - 1) * (width + 1) >= looks->cells)
        return OUTSIDE;
    const int8_t *from = looks->walls + arena * looks->cells + corner;
    for (int64_t row = 0; row < side; row++)
        memcpy(view + row * side, from + row * width, side);
    draw(looks->own + arena * looks->team, looks->team, corner, looks, view);
    draw(looks->people + arena * looks->num_people, looks->num_people, corner, looks, view);
    view[side * side / 2] = OPEN;
    return DONE;
}

/* Looks for robots `first` to `last` - 1, numbered over all arenas; a team has one mask for all or
 * one for each robot, and `side` is odd. Returns 0, 1 when memory is out, or 2 when a window is
 * outside its arena. */
int marl_explore_surroundings(const Looks *looks, int64_t first, int64_t last) {
    const int64_t cells = looks->side * looks->side;
    Windows windows;
    void *memory = allocate(&windows, looks->side, 0);
    if (memory == NULL)
        return NO_MEMORY;
    int failed = DONE;
    for (; first < last && !failed; first += LANES) {
        const int64_t lanes = least(LANES, last - first);
        for (int64_t i = 0; i < lanes && !failed; i++) {
            int8_t *view = looks->view + (first + i) * cells;
            failed = copy_window(looks, first + i, view);
            memcpy(windows.rows + i * windows.cells, view, cells);
        }
        if (looks->hides) {
            to_lanes(windows);
            look(windows);
            from_lanes(windows);
        } else {
            memset(windows.rows, 1, lanes * windows.cells);
        }
        for (int64_t i = 0; i < lanes; i++) {
            int8_t *view = looks->view + (first + i) * cells;
            const int8_t *seen = windows.rows + i * windows.cells;
            const uint8_t *mask = looks->masks + (first + i) % looks->num_kinds * cells;
            for (int64_t cell = 0; cell < cells; cell++)
                view[cell] = seen[cell] & mask[cell] ? view[cell] : UNSEEN;
        }
    }
    free(memory);
    return failed;
}

/* Writes a row of a view into a row of a map. */
static void sense_row(const int8_t *restrict view, const uint8_t *restrict target,
                      int8_t *restrict map, int cells, int64_t *discovered, int64_t *targets) {
    int new_cells = 0, new_targets = 0;
    for (int i = 0; i < cells; i++) {
        const int8_t unseen = -(view[i] == UNSEEN), fresh = ~unseen & -(map[i] == UNKNOWN);
        new_cells -= fresh;
        new_targets += fresh & target[i] & 1;
        map[i] = (unseen & map[i]) | (~unseen & view[i] & WALL);
    }
    *discovered += new_cells;
    *targets += new_targets;
}

/* Writes what robots `first` to `last` - 1 see into their maps. Returns 0, or 2 when a robot is
 * outside its map. */
int marl_explore_sense(const Readings *readings, int64_t first, int64_t last) {
    const int64_t height = readings->height, width = readings->width, side = readings->side;
    const int64_t radius = side / 2;
    for (int64_t robot = first; robot < last; robot++) {
        const int64_t row = readings->position[2 * robot];
        const int64_t column = readings->position[2 * robot + 1];
        if (!is_inside(row, column, height, width))
            return OUTSIDE;
        const int8_t *view = readings->view + robot * side * side;
        const uint8_t *target = readings->target + robot / readings->team * height * width;
        int8_t *map = readings->maps + robot * height * width;
        const int64_t left = most(column - radius, 0), right = least(column + radius, width - 1);
        const int64_t top = most(row - radius, 0), bottom = least(row + radius, height - 1);
        const int is_alive = readings->alive == NULL || readings->alive[robot];
        int64_t discovered = 0, targets = 0;
        for (int64_t r = top; is_alive && r <= bottom; r++)
            sense_row(view + (r - row + radius) * side + left - column + radius,
                      target + r * width + left, map + r * width + left, (int)(right - left + 1),
                      &discovered, &targets);
        readings->discovered[robot] = discovered;
        readings->targets[robot] = targets;
    }
    return DONE;
}
