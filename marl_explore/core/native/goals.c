/* The candidate goals of many robots (docs/goals.md says what they are, core/goals.py is the
 * reference).
 *
 * Plain C99, no dependency but the standard library; one call is one thread's share of robots.
 * Paths spread over sets of cells, a bit each, so that a level of a search is a few operations on
 * every row. Only the robot's own search looks at cells one by one, once each, for the first moves.
 */
#include "grid.h"

#include <stdlib.h>

enum { MAX_FRONTIERS = 24, COLUMNS = 14 };
enum { LARGE_POCKET = 64, FAR_CELLS = 20, DETOUR_CELLS = 4 };
enum { WORD_BITS = 64, SLACK = 8 };

typedef uint64_t Word;

/* Arrays of all robots, each of which knows a team of `team`; bools are a byte each, 0 or 1. */
typedef struct {
    const int8_t *maps;         /* [robots, height, width] */
    const int64_t *positions;   /* [robots, 2] */
    const uint8_t *taken;       /* [robots, 8] */
    const uint8_t *allowed;     /* [robots, 8] */
    const int64_t *seen_steps;  /* [robots, team], negative for never */
    const int64_t *seen_cells;  /* [robots, team, 2] */
    const uint8_t *known_by;    /* [robots, team, height, width] */
    const uint8_t *covered;     /* [robots, height, width] */
    const int64_t *headings;    /* [robots] */
    const int64_t *goals;       /* [robots, 2] */
    const int64_t *radii;       /* [kinds], k of each robot of a team, or one for all */
    const int64_t *gains;       /* [robots, 8], unseen cells that a robot would see after each move;
                                 * NULL: those in the square of radius k */
    int32_t *frontiers;         /* [robots, 24, 14] */
    int32_t *rivals;            /* [robots, 24, team, 2] */
    int32_t *ways;              /* [robots, team, 2] */
    uint8_t *all_covered;       /* [robots] */
    int64_t team, height, width, kinds;
} Batch;

typedef struct {
    int32_t row, column, cell, moves;
} Place;

/* Work space of one thread. Grids have a byte or a number per cell and a border (grid.h). Sets have
 * a bit per cell, `words` words a row, with an empty row above the first and one below the last. */
typedef struct {
    int64_t height, width, stride, words;

    int8_t *code;       /* grid: UNKNOWN, FREE or OCCUPIED; the border is occupied */
    uint8_t *rise;      /* grid: 255, or 0 where the diagonal to the north-east is closed */
    uint8_t *fall;      /* grid: the same to the north-west */
    uint8_t *region;    /* grid: number of the unseen region, or UNVISITED; 0 where seen */
    uint8_t *labels[2]; /* grids: first moves of all shortest paths to a cell, one bit each; of paths
                         * of even and of odd length */
    int32_t *moves;     /* grid: their length */

    Word *free;      /* set: where paths may lead */
    Word *passable;  /* set: cells that close no diagonal */
    Word *unknown;   /* set */
    Word *unseen;    /* set */
    Word *frontier;  /* set: free cells beside unknown ones */
    Word *open;      /* set: free cells beside unseen ones */
    Word *fresh;     /* set: free cells that no path has come to */
    Word *front;     /* set: cells that the last step of all paths came to */
    Word *sideways;  /* sets: cells that half a step leads to from there */
    Word *upright;
    int64_t first, last; /* rows of the front */

    Place *found;   /* open frontiers in the order in which paths come to them */
    int32_t *sums;  /* unseen cells above and to the left, [height + 1, width + 1] */
    int32_t *queue; /* cells of a region */
} Space;

/* The thinned list of open frontiers. */
typedef struct {
    int number;
    int32_t row[MAX_FRONTIERS], column[MAX_FRONTIERS], cell[MAX_FRONTIERS], moves[MAX_FRONTIERS];
    int32_t merged[MAX_FRONTIERS]; /* cells that it stands for */
} Chosen;

/* The moves of a robot, the best of equally short ones first. */
typedef struct {
    int order[DIRECTIONS];
    int32_t gain[DIRECTIONS];
} Moves;

static inline int32_t straight(int32_t row, int32_t column, int32_t other_row,
                               int32_t other_column) {
    const int32_t rows = abs(row - other_row), columns = abs(column - other_column);
    return rows > columns ? rows : columns;
}

static int lowest_bit(Word word) {
#ifdef __GNUC__
    return __builtin_ctzll(word);
#else
    int bit = 0;
    while (!(word >> bit & 1))
        bit++;
    return bit;
#endif
}

/* ------------------------------------------------------------------------ work space */

/* With more than one word a row, neighbours are carried over between words. Then rows end in a bit
 * that is in no set, so that the first cell of a row is not beside the last of the row above. */
static int64_t words_of(int64_t width) {
    return width <= WORD_BITS ? 1 : width / WORD_BITS + 1;
}

/* Returns the memory that the work space lies in, or NULL. */
static void *allocate(Space *space, int64_t height, int64_t width) {
    const int64_t cells = bordered_cells(height, width), inside = height * width;
    const int64_t words = words_of(width), set = (height + 2) * words;
    enum { SETS = 10, NUMBERS = 2, BYTES = 6 };
    Word *sets = calloc(1, SETS * set * sizeof(Word) + inside * sizeof(Place) +
                               (NUMBERS * cells + (height + 1) * (width + 1)) * sizeof(int32_t) +
                               BYTES * (cells + SLACK));
    if (sets == NULL)
        return NULL;
    *space = (Space){.height = height, .width = width, .stride = width + 1, .words = words};
    Word **const each_set[SETS] = {&space->free,     &space->passable, &space->unknown,
                                   &space->unseen,   &space->frontier, &space->open,
                                   &space->front,    &space->fresh,    &space->sideways,
                                   &space->upright};
    for (int i = 0; i < SETS; i++)
        *each_set[i] = sets + i * set;
    space->found = (Place *)(sets + SETS * set);
    space->moves = (int32_t *)(space->found + inside);
    space->queue = space->moves + cells;
    space->sums = space->queue + cells;
    space->code = (int8_t *)(space->sums + (height + 1) * (width + 1));
    space->rise = (uint8_t *)space->code + cells + SLACK;
    space->fall = space->rise + cells + SLACK;
    space->labels[0] = space->fall + cells + SLACK;
    space->labels[1] = space->labels[0] + cells + SLACK;
    space->region = space->labels[1] + cells + SLACK;
    memset(space->code, OCCUPIED, cells + SLACK);
    return sets;
}

static int64_t cell_of(const Space *space, int64_t row, int64_t column) {
    return (row + 1) * space->stride + column + 1;
}

static int64_t word_of(const Space *space, int64_t row, int64_t column) {
    return (row + 1) * space->words + column / WORD_BITS;
}

static Word bit_of(int64_t column) { return (Word)1 << column % WORD_BITS; }

/* --------------------------------------------------------------------- what is known */

enum { UNVISITED = 255 };

/* The lowest bits of eight bytes. */
static Word eight_bits(Word bytes) {
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
    const Word shifts = UINT64_C(0x8040201008040201);
#else
    const Word shifts = UINT64_C(0x0102040810204080);
#endif
    return (bytes & UINT64_C(0x0101010101010101)) * shifts >> 56;
}

/* Unseen cells as a grid, and their sums for `count_around`. */
static void read_unseen(Space *space, const int8_t *map, const uint8_t *covered) {
    const int64_t width = space->width;
    for (int64_t row = 0; row < space->height; row++) {
        const int8_t *restrict code = map + row * width;
        const uint8_t *restrict left = covered + row * width;
        uint8_t *restrict region = space->region + cell_of(space, row, 0);
        const int32_t *restrict above = space->sums + row * space->stride + 1;
        int32_t *restrict sums = space->sums + (row + 1) * space->stride + 1, sum = 0;
        for (int64_t column = 0; column < width; column++)
            region[column] = (code[column] == UNKNOWN) & (left[column] == 0) ? UNVISITED : 0;
        for (int64_t column = 0; column < width; column++) {
            sum += region[column] & 1;
            sums[column] = above[column] + sum;
        }
    }
}

/* Which diagonals are not closed: those between two occupied cells are. */
static void read_diagonals(Space *space) {
    const int64_t stride = space->stride, cells = bordered_cells(space->height, space->width);
    const int8_t *code = space->code;
    uint8_t *rise = space->rise, *fall = space->fall;
    for (int64_t cell = stride; cell < cells; cell++) {
        const int walled = code[cell - stride] == OCCUPIED;
        rise[cell] = walled & (code[cell + 1] == OCCUPIED) ? 0 : 255;
        fall[cell] = walled & (code[cell - 1] == OCCUPIED) ? 0 : 255;
    }
}

/* Of the codes only FREE, 0, has an even number, and only UNKNOWN, -1, is negative. */
static void read_sets(Space *space) {
    for (int64_t row = 0; row < space->height; row++) {
        const int8_t *code = space->code + cell_of(space, row, 0);
        const uint8_t *region = space->region + cell_of(space, row, 0);
        for (int64_t column = 0; column < space->width; column += WORD_BITS) {
            const int64_t i = word_of(space, row, column), left = space->width - column;
            const Word inside = left < WORD_BITS ? bit_of(left) - 1 : ~(Word)0;
            Word odd = 0, unknown = 0, unseen = 0;
            for (int64_t bit = 0; bit < least(left, WORD_BITS); bit += 8) {
                Word codes, regions;
                memcpy(&codes, code + column + bit, sizeof codes);
                memcpy(&regions, region + column + bit, sizeof regions);
                odd |= eight_bits(codes) << bit;
                unknown |= eight_bits(codes >> 7) << bit;
                unseen |= eight_bits(regions) << bit;
            }
            space->free[i] = ~odd & inside;
            space->passable[i] = (~odd | unknown) & inside;
            space->unknown[i] = unknown & inside;
            space->unseen[i] = unseen & inside;
        }
    }
}

/* Free cells with a 4-neighbour in a set. */
static void free_beside(const Space *space, const Word *set, Word *beside) {
    const int64_t words = space->words;
    for (int64_t i = words; i < (space->height + 1) * words; i++) {
        Word next = set[i] << 1 | set[i] >> 1 | set[i - words] | set[i + words];
        if (words > 1)
            next |= set[i - 1] >> (WORD_BITS - 1) | set[i + 1] << (WORD_BITS - 1);
        beside[i] = next & space->free[i];
    }
}

static void read_map(Space *space, const int8_t *map, const uint8_t *covered) {
    copy_inside(space->code, map, space->height, space->width);
    read_unseen(space, map, covered);
    read_diagonals(space);
    read_sets(space);
    free_beside(space, space->unknown, space->frontier);
    free_beside(space, space->unseen, space->open);
}

/* Unseen cells in the square around a cell. */
static int32_t count_around(const Space *space, int64_t row, int64_t column, int64_t radius) {
    const int64_t left = most(column - radius, 0), top = most(row - radius, 0);
    const int64_t right = least(column + radius + 1, space->width);
    const int64_t bottom = least(row + radius + 1, space->height);
    const int32_t *above = space->sums + top * space->stride;
    const int32_t *below = space->sums + bottom * space->stride;
    return below[right] - below[left] - above[right] + above[left];
}

/* ----------------------------------------------------------------------------- paths */

/* One step of all paths, where it can lead to: words `from` to `to` - 1. The front becomes those of
 * its neighbours that are fresh. A diagonal is two straight half steps; one order of them must not
 * cross an occupied cell. `words` and `wide` are arguments so that the compiler knows them. */
static inline void spread(const Space *space, int64_t from, int64_t to, int64_t words, int wide) {
    const Word *restrict passable = space->passable;
    Word *restrict front = space->front, *restrict fresh = space->fresh;
    Word *restrict sideways = space->sideways, *restrict upright = space->upright;
    const int64_t end = (space->height + 1) * words;
    for (int64_t i = most(from - words, words); i < least(to + words, end); i++) {
        Word side = front[i] << 1 | front[i] >> 1;
        if (wide)
            side |= front[i - 1] >> (WORD_BITS - 1) | front[i + 1] << (WORD_BITS - 1);
        sideways[i] = front[i] | (side & passable[i]);
        upright[i] = (front[i - words] | front[i + words]) & passable[i];
    }
    for (int64_t i = from; i < to; i++) {
        Word next = sideways[i - words] | sideways[i] | sideways[i + words];
        next |= upright[i] << 1 | upright[i] >> 1;
        if (wide)
            next |= upright[i - 1] >> (WORD_BITS - 1) | upright[i + 1] << (WORD_BITS - 1);
        front[i] = next & fresh[i];
        fresh[i] &= ~next;
    }
}

static int is_empty(const Word *set, int64_t row, int64_t words) {
    Word any = 0;
    for (int64_t i = row * words; i < (row + 1) * words; i++)
        any |= set[i];
    return any == 0;
}

/* One step of all paths; returns whether any of them came to a new cell. */
static int advance(Space *space) {
    const int64_t words = space->words;
    int64_t first = most(space->first - 1, 1), last = least(space->last + 1, space->height);
    if (words == 1)
        spread(space, first, last + 1, 1, 0);
    else
        spread(space, first * words, (last + 1) * words, words, 1);
    while (first <= last && is_empty(space->front, first, words))
        first++;
    while (first < last && is_empty(space->front, last, words))
        last--;
    space->first = first;
    space->last = last;
    return first <= last;
}

/* Paths over free cells begin in a cell that need not be one. */
static void begin(Space *space, int64_t row, int64_t column) {
    const int64_t set = (space->height + 2) * space->words, i = word_of(space, row, column);
    memset(space->front, 0, set * sizeof(Word));
    memcpy(space->fresh, space->free, set * sizeof(Word));
    space->front[i] = bit_of(column);
    space->fresh[i] &= ~bit_of(column);
    space->first = space->last = row + 1;
}

/* First moves of the shortest paths to a cell, from the labels of the other parity. Its neighbours
 * without a closed diagonal between are at most one move nearer or farther, and those that are
 * farther have no labels yet. */
static inline uint8_t pull(const uint8_t *labels, const uint8_t *rise, const uint8_t *fall,
                           int64_t stride) {
    return labels[-stride] | labels[1] | labels[stride] | labels[-1] |
           (labels[1 - stride] & rise[0]) | (labels[-1 - stride] & fall[0]) |
           (labels[stride - 1] & rise[stride - 1]) | (labels[stride + 1] & fall[stride + 1]);
}

/* Length and labels of all cells of the front, and the open frontiers among them. */
static int64_t visit_front(Space *space, int32_t level, int64_t found) {
    const int64_t stride = space->stride;
    const uint8_t *restrict before = space->labels[(level - 1) % 2];
    const uint8_t *restrict rise = space->rise, *restrict fall = space->fall;
    uint8_t *restrict labels = space->labels[level % 2];
    int32_t *restrict moves = space->moves;
    Place *restrict places = space->found;
    for (int64_t row = space->first - 1; row < space->last; row++)
        for (int64_t column = 0; column < space->width; column += WORD_BITS) {
            const int64_t i = word_of(space, row, column), cell = cell_of(space, row, column);
            const Word open = space->open[i];
            for (Word left = space->front[i]; left != 0; left &= left - 1) {
                const int bit = lowest_bit(left);
                const int64_t next = cell + bit;
                moves[next] = level;
                labels[next] = pull(before + next, rise + next, fall + next, stride);
                places[found] = (Place){(int32_t)row, (int32_t)column + bit, (int32_t)next, level};
                found += open >> bit & 1; /* without a branch, which would be hard to predict */
            }
        }
    return found;
}

/* One move, and it is the first. */
static void label_neighbours(Space *space, int64_t row, int64_t column) {
    for (int d = 0; d < DIRECTIONS; d++) {
        const int64_t next_row = row + STEP_ROW[d], next = column + STEP_COLUMN[d];
        if (is_inside(next_row, next, space->height, space->width) &&
            space->front[word_of(space, next_row, next)] & bit_of(next))
            space->labels[1][cell_of(space, next_row, next)] = (uint8_t)(1 << d);
    }
}

/* Paths do not come to taken cells, so they are no frontiers that count. */
static void close_taken(Space *space, int64_t row, int64_t column, const uint8_t *taken) {
    for (int d = 0; d < DIRECTIONS; d++) {
        const int64_t next_row = row + STEP_ROW[d], next = column + STEP_COLUMN[d];
        if (taken[d] && is_inside(next_row, next, space->height, space->width)) {
            space->fresh[word_of(space, next_row, next)] &= ~bit_of(next);
            space->frontier[word_of(space, next_row, next)] &= ~bit_of(next);
        }
    }
}

/* The robot's own paths; returns the number of open frontiers. */
static int64_t find_paths(Space *space, int64_t row, int64_t column, const uint8_t *taken) {
    int64_t found = 0;
    memset(space->labels[0], 0, bordered_cells(space->height, space->width));
    memset(space->labels[1], 0, bordered_cells(space->height, space->width));
    begin(space, row, column);
    space->moves[cell_of(space, row, column)] = 0;
    space->frontier[word_of(space, row, column)] &= ~bit_of(column); /* no path leads there */
    close_taken(space, row, column, taken);
    for (int32_t level = 1; advance(space); level++) {
        found = visit_front(space, level, found);
        if (level == 1)
            label_neighbours(space, row, column);
    }
    return found;
}

/* Whether the robot's own paths came to any frontier, open or not. */
static int reaches_frontiers(const Space *space) {
    Word any = 0;
    for (int64_t i = 0; i < (space->height + 2) * space->words; i++)
        any |= space->frontier[i] & ~space->fresh[i];
    return any != 0;
}

/* Lengths of the shortest paths from a cell to all candidates, -1 without one. */
static void measure(Space *space, int64_t row, int64_t column, const Chosen *chosen,
                    int32_t *length) {
    int left[MAX_FRONTIERS], number = chosen->number;
    int64_t words[MAX_FRONTIERS];
    for (int i = 0; i < number; i++) {
        words[i] = word_of(space, chosen->row[i], chosen->column[i]);
        left[i] = i;
        length[i] = -1;
    }
    int32_t level = 0;
    begin(space, row, column);
    do {
        for (int i = 0; i < number;) {
            const int candidate = left[i];
            if (space->front[words[candidate]] & bit_of(chosen->column[candidate])) {
                length[candidate] = level;
                left[i] = left[--number];
            } else {
                i++;
            }
        }
        level++;
    } while (number > 0 && advance(space));
}

/* ------------------------------------------------------------------------ candidates */

/* The first candidate, of those from `from` on, that a cell is at most `reach` away from. */
static int absorber(const Chosen *chosen, int from, const Place *place, int64_t reach) {
    int i = from;
    while (i < chosen->number &&
           straight(place->row, place->column, chosen->row[i], chosen->column[i]) > reach)
        i++;
    return i;
}

static void add(Chosen *chosen, const Place *place) {
    const int i = chosen->number++;
    chosen->row[i] = place->row;
    chosen->column[i] = place->column;
    chosen->cell[i] = place->cell;
    chosen->moves[i] = place->moves;
    chosen->merged[i] = 1;
}

/* `found` is in the order of moves, row and column. */
static void thin(const Space *space, int64_t found, int64_t radius, Chosen *chosen) {
    int far = 0; /* candidates before this one are too near to absorb any */
    chosen->number = 0;
    for (int64_t i = 0; i < found; i++) {
        const Place *place = &space->found[i];
        int by = chosen->number;
        if (place->moves <= 2 * radius)
            far = by + 1;
        else
            by = absorber(chosen, far, place, (place->moves > 6 * radius ? 2 : 1) * radius);
        if (by < chosen->number)
            chosen->merged[by]++;
        else if (by < MAX_FRONTIERS)
            add(chosen, place);
    }
}

/* Unseen cells that a robot would see after a move. */
static int32_t move_gain(const Space *space, const Batch *batch, int64_t robot, int64_t radius,
                         int direction) {
    const int64_t *from = batch->positions + 2 * robot;
    const int64_t row = from[0] + STEP_ROW[direction], column = from[1] + STEP_COLUMN[direction];
    if (!is_inside(row, column, space->height, space->width))
        return 0;
    return batch->gains ? (int32_t)batch->gains[robot * DIRECTIONS + direction]
                        : count_around(space, row, column, radius);
}

/* Allowed moves before others, then those with the larger gain, then the lower directions. */
static Moves rank_moves(const Space *space, const Batch *batch, int64_t robot, int64_t radius) {
    const uint8_t *allowed = batch->allowed + robot * DIRECTIONS;
    Moves moves;
    for (int d = 0; d < DIRECTIONS; d++) {
        const int32_t gain = move_gain(space, batch, robot, radius, d);
        int place = d;
        for (; place > 0; place--) {
            const int other = moves.order[place - 1], same = !allowed[other] == !allowed[d];
            if (same ? moves.gain[other] >= gain : allowed[other])
                break;
            moves.order[place] = other;
        }
        moves.order[place] = d;
        moves.gain[d] = gain;
    }
    return moves;
}

static int first_move(const Space *space, const Moves *moves, int64_t cell) {
    const int labels = space->labels[space->moves[cell] % 2][cell];
    int i = 0;
    while (!(labels >> moves->order[i] & 1))
        i++;
    return moves->order[i];
}

/* Sizes of the unseen regions that have been visited, by their number. */
typedef struct {
    int number;
    int32_t size[4 * MAX_FRONTIERS + 1];
} Regions;

/* Size of the unseen region that a cell belongs to, at most LARGE_POCKET; 0 for seen cells. Larger
 * regions are left when that many of their cells are numbered. Later visits come to other cells of
 * them, and where they meet the earlier number they know that the region is large: smaller ones are
 * numbered completely. */
static int32_t region_size(Space *space, Regions *regions, int64_t cell) {
    uint8_t *region = space->region;
    const int64_t steps[4] = {-space->stride, 1, space->stride, -1};
    int32_t *queue = space->queue;
    if (region[cell] != UNVISITED)
        return region[cell] ? regions->size[region[cell]] : 0;
    const int number = ++regions->number;
    int32_t head = 0, tail = 0;
    queue[tail++] = (int32_t)cell;
    region[cell] = (uint8_t)number;
    while (head < tail && tail < LARGE_POCKET) {
        const int64_t from = queue[head++];
        for (int i = 0; i < 4 && tail < LARGE_POCKET; i++) {
            const int64_t next = from + steps[i];
            if (region[next] == UNVISITED) {
                region[next] = (uint8_t)number;
                queue[tail++] = (int32_t)next;
            } else if (region[next] != 0 && region[next] != number) {
                tail = LARGE_POCKET;
            }
        }
    }
    return regions->size[number] = tail;
}

static int32_t largest_pocket(Space *space, Regions *regions, int64_t cell) {
    const int64_t beside[4] = {cell - space->stride, cell + 1, cell + space->stride, cell - 1};
    int32_t largest = 0;
    for (int i = 0; i < 4 && largest < LARGE_POCKET; i++)
        largest = (int32_t)most(largest, region_size(space, regions, beside[i]));
    return largest;
}

static int32_t isolation(const Chosen *chosen, int candidate, int32_t radius) {
    const int32_t row = chosen->row[candidate], column = chosen->column[candidate];
    int32_t smallest = FAR_CELLS;
    for (int i = 0; i < chosen->number; i++) {
        const int32_t apart = straight(row, column, chosen->row[i], chosen->column[i]);
        const int32_t counted = apart > radius ? apart : FAR_CELLS;
        smallest = counted < smallest ? counted : smallest;
    }
    return smallest;
}

static int32_t turn(int move, int64_t heading) {
    const int around = (int)((uint64_t)move - (uint64_t)heading) & (DIRECTIONS - 1);
    return heading < 0 ? -1 : around <= DIRECTIONS / 2 ? around : DIRECTIONS - around;
}

/* ------------------------------------------------------------------------- the tables */

static void write_frontiers(Space *space, const Batch *batch, int64_t robot, int64_t radius,
                            const Chosen *chosen, const Moves *moves) {
    const int64_t *goal = batch->goals + 2 * robot;
    int32_t *entries = batch->frontiers + robot * MAX_FRONTIERS * COLUMNS;
    Regions regions = {.number = 0};
    for (int i = 0; i < chosen->number; i++, entries += COLUMNS) {
        const int32_t row = chosen->row[i], column = chosen->column[i];
        const int move = first_move(space, moves, chosen->cell[i]);
        const int32_t entry[COLUMNS] = {
            row,
            column,
            chosen->moves[i],
            move,
            chosen->merged[i],
            count_around(space, row, column, radius),
            count_around(space, row, column, 2 * radius),
            count_around(space, row, column, 4 * radius),
            largest_pocket(space, &regions, chosen->cell[i]),
            isolation(chosen, i, (int32_t)least(radius, FAR_CELLS)),
            moves->gain[move],
            batch->allowed[robot * DIRECTIONS + move] != 0,
            turn(move, batch->headings[robot]),
            goal[0] < 0 ? -1 : straight(row, column, (int32_t)goal[0], (int32_t)goal[1]),
        };
        memcpy(entries, entry, sizeof entry);
    }
    memset(entries, 0, (MAX_FRONTIERS - chosen->number) * COLUMNS * sizeof *entries);
}

/* The nearer, along the robot's paths, of a cell and the nearest one until now (-1 for none). */
static int64_t nearer(const Space *space, int64_t own, int64_t cell, int64_t nearest) {
    const int reached = cell == own || (space->labels[0][cell] | space->labels[1][cell]) != 0;
    return reached && (nearest < 0 || space->moves[cell] < space->moves[nearest]) ? cell : nearest;
}

/* Of the cells in a ring around one, in the order of their rows and columns, the one with the
 * shortest path; -1 if there are no paths to any. */
static int64_t nearest_in_ring(const Space *space, int64_t own, int64_t row, int64_t column,
                               int64_t ring) {
    const int64_t top = row - ring, bottom = row + ring;
    const int64_t left = column - ring, right = column + ring;
    int64_t nearest = -1;
    for (int64_t r = most(top, 0); r <= least(bottom, space->height - 1); r++) {
        if (r == top || r == bottom) {
            for (int64_t c = most(left, 0); c <= least(right, space->width - 1); c++)
                nearest = nearer(space, own, cell_of(space, r, c), nearest);
            continue;
        }
        if (left >= 0)
            nearest = nearer(space, own, cell_of(space, r, left), nearest);
        if (right < space->width)
            nearest = nearer(space, own, cell_of(space, r, right), nearest);
    }
    return nearest;
}

static void write_way(const Space *space, const Moves *moves, int64_t own, int64_t row,
                      int64_t column, int32_t *way) {
    int64_t ring = 0, nearest;
    while ((nearest = nearest_in_ring(space, own, row, column, ring)) < 0)
        ring++; /* one of them has the robot's own cell */
    if (nearest != own) {
        way[0] = space->moves[nearest] + (int32_t)ring;
        way[1] = first_move(space, moves, nearest);
    }
}

static void write_rival(Space *space, const Batch *batch, const Chosen *chosen, int64_t pair,
                        int32_t *rival) {
    const int64_t *seen = batch->seen_cells + 2 * pair;
    const int32_t seen_row = (int32_t)seen[0], seen_column = (int32_t)seen[1];
    const uint8_t *known = batch->known_by + pair * space->height * space->width;
    int32_t length[MAX_FRONTIERS];
    measure(space, seen_row, seen_column, chosen, length);
    for (int i = 0; i < chosen->number; i++, rival += 2 * batch->team) {
        const int32_t row = chosen->row[i], column = chosen->column[i];
        if (length[i] < 0)
            length[i] = straight(row, column, seen_row, seen_column) + DETOUR_CELLS;
        rival[0] = length[i];
        rival[1] = known[row * space->width + column] != 0;
    }
}

static int write_teammates(Space *space, const Batch *batch, int64_t robot, const Chosen *chosen,
                           const Moves *moves) {
    const int64_t team = batch->team, *position = batch->positions + 2 * robot;
    const int64_t own = cell_of(space, position[0], position[1]);
    int32_t *rivals = batch->rivals + robot * MAX_FRONTIERS * team * 2;
    int32_t *way = batch->ways + robot * team * 2;
    memset(rivals, 0, MAX_FRONTIERS * team * 2 * sizeof *rivals);
    for (int64_t mate = 0; mate < team; mate++, way += 2) {
        const int64_t pair = robot * team + mate, *seen = batch->seen_cells + 2 * pair;
        way[0] = 0;
        way[1] = -1;
        if (batch->seen_steps[pair] < 0) { /* never */
            for (int i = 0; i < chosen->number; i++)
                rivals[(i * team + mate) * 2] = -1;
            continue;
        }
        if (!is_inside(seen[0], seen[1], space->height, space->width))
            return SEEN_OUTSIDE;
        write_way(space, moves, own, seen[0], seen[1], way);
        write_rival(space, batch, chosen, pair, rivals + 2 * mate);
    }
    return DONE;
}

static int write_robot(Space *space, const Batch *batch, int64_t robot) {
    const int64_t row = batch->positions[2 * robot], column = batch->positions[2 * robot + 1];
    const int64_t cells = space->height * space->width;
    const int64_t radius = batch->radii[robot % batch->kinds];
    if (!is_inside(row, column, space->height, space->width))
        return OUTSIDE;
    Chosen chosen;
    read_map(space, batch->maps + robot * cells, batch->covered + robot * cells);
    const int64_t open = find_paths(space, row, column, batch->taken + robot * DIRECTIONS);
    thin(space, open, radius, &chosen);
    batch->all_covered[robot] = open == 0 && reaches_frontiers(space);
    const Moves moves = rank_moves(space, batch, robot, radius);
    write_frontiers(space, batch, robot, radius, &chosen, &moves);
    return write_teammates(space, batch, robot, &chosen, &moves);
}

/* The tables of robots `first` to `last` - 1; near gains are those in the square of radius k.
 * Returns 0, 1 when memory is out, 2 when a position is outside its map, or 3 when a cell is in
 * which a teammate was seen. */
int marl_explore_goal_tables(const Batch *batch, int64_t first, int64_t last) {
    Space space;
    void *memory = allocate(&space, batch->height, batch->width);
    int failed = memory == NULL ? NO_MEMORY : DONE;
    for (int64_t robot = first; robot < last && !failed; robot++)
        failed = write_robot(&space, batch, robot);
    free(memory);
    return failed;
}
