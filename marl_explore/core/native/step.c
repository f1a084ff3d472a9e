/* A step of the world (core/world.py is the reference): robots move, sense and merge their maps, in
 * arenas without walkers, failures, lost messages, waiting robots or walls that weaken radio.
 *
 * Plain C99, no dependency but the standard library; one call is one thread's share.
 */
#include "world.h"

enum { STAY = 8, COMMUNICATE = 9, ACTIONS = 10 };
enum { ROW = 1 << 16 }; /* more than any width: row * ROW + column is a cell, also outside */

/* The batch before the step and after it. */
typedef struct {
    const int8_t *walls;     /* [arenas, height + side - 1, width + side - 1], as for Looks */
    const uint8_t *masks;    /* [num_kinds, side, side], the shapes of sensors */
    const uint8_t *target;   /* [arenas, height, width], cells that are counted apart */
    const int64_t *action;   /* [arenas, team] */
    const int64_t *start;    /* [arenas, team, 2], row and column before the step */
    const uint8_t *allowed;  /* [arenas, team, 10], open actions before the step */
    const int64_t *unshared; /* [arenas, team, team], before the step */
    const int64_t *waited;   /* [arenas, team, team], steps since the last merge, before */
    const int64_t *known;    /* [arenas, team], known cells before the step */
    const int64_t *missing;  /* [arenas, team], unknown targets before the step */
    int8_t *maps;            /* [arenas, team, height, width], changed */
    int64_t *position;       /* [arenas, team, 2], and all others, after the step */
    uint8_t *dangerous;      /* [arenas, team], moves that were refused */
    int8_t *view;            /* [arenas, team, side, side] */
    uint8_t *linked;         /* [arenas, team, team] */
    uint8_t *network;        /* [arenas, team, team]; 0 before the call */
    int64_t *pending;        /* [arenas, team, team], unshared before merges reset it */
    int64_t *new_unshared;   /* [arenas, team, team] */
    int64_t *new_waited;     /* [arenas, team, team] */
    uint8_t *new_allowed;    /* [arenas, team, 10] */
    int64_t *discovered;     /* [arenas, team] */
    int64_t *received;       /* [arenas, team]; 0 before the call */
    int64_t *new_known;      /* [arenas, team] */
    int64_t *new_missing;    /* [arenas, team] */
    int64_t *own;            /* [arenas, team], work space */
    int64_t *targets;        /* [arenas, team], work space */
    int64_t *more_targets;   /* [arenas, team], work space; 0 before the call */
    uint8_t *communicating;  /* [arenas, team], work space */
    int64_t team, height, width, num_kinds, side, hides;
    int64_t reach; /* largest squared distance of linked robots (cells) */
    int64_t never; /* most steps that are counted since a merge */
} Step;

/* Moves the robots of an arena; returns NO_SUCH for an action that is none. */
static int move(const Step *step, int64_t arena) {
    const int64_t team = step->team, radius = step->side / 2;
    const int64_t stride = step->width + 2 * radius;
    const int64_t *start = step->start + arena * team * 2, *action = step->action + arena * team;
    const uint8_t *allowed = step->allowed + arena * team * ACTIONS;
    int64_t *goal = step->own + arena * team; /* until it has the robots' cells */
    for (int64_t i = 0; i < team; i++) {
        if (action[i] < 0 || action[i] >= ACTIONS)
            return NO_SUCH;
        goal[i] = start[2 * i] * ROW + start[2 * i + 1];
        if (action[i] < DIRECTIONS)
            goal[i] += STEP_ROW[action[i]] * ROW + STEP_COLUMN[action[i]];
        step->communicating[arena * team + i] = action[i] == COMMUNICATE;
    }
    for (int64_t i = 0; i < team; i++) {
        int refused = !allowed[i * ACTIONS + action[i]];
        const int64_t from = start[2 * i] * ROW + start[2 * i + 1];
        for (int64_t j = 0; j < team; j++) { /* equal sums: paths with one midpoint cross */
            const int64_t other = start[2 * j] * ROW + start[2 * j + 1];
            refused |= (i != j) & ((goal[i] == goal[j]) | (from + goal[i] == other + goal[j]));
        }
        step->dangerous[arena * team + i] = refused & (action[i] < DIRECTIONS);
    }
    for (int64_t i = 0; i < team; i++) {
        const int64_t robot = arena * team + i;
        const int moves = action[i] < DIRECTIONS && !step->dangerous[robot];
        const int64_t row = start[2 * i] + (moves ? STEP_ROW[action[i]] : 0);
        const int64_t column = start[2 * i + 1] + (moves ? STEP_COLUMN[action[i]] : 0);
        step->position[2 * robot] = row;
        step->position[2 * robot + 1] = column;
        step->own[robot] = (row + radius) * stride + column + radius;
    }
    return DONE;
}

/* Links the robots of an arena that are near each other. */
static void link_near(const Step *step, int64_t arena) {
    const int64_t team = step->team, *position = step->position + arena * team * 2;
    uint8_t *linked = step->linked + arena * team * team;
    for (int64_t i = 0; i < team; i++)
        for (int64_t j = 0; j < team; j++) {
            const int64_t down = position[2 * i] - position[2 * j];
            const int64_t across = position[2 * i + 1] - position[2 * j + 1];
            linked[i * team + j] = down * down + across * across <= step->reach;
        }
}

/* Counts for every robot of an arena what it knows, and has not shared. */
static void count(const Step *step, int64_t arena) {
    const int64_t team = step->team;
    for (int64_t robot = arena * team; robot < (arena + 1) * team; robot++) {
        const int64_t discovered = step->discovered[robot];
        step->new_known[robot] = step->known[robot] + discovered + step->received[robot];
        step->new_missing[robot] =
            step->missing[robot] - step->targets[robot] - step->more_targets[robot];
        for (int64_t j = 0; j < team; j++) {
            const int64_t pair = robot * team + j, is_other = robot - arena * team != j;
            const int64_t pending = is_other ? step->unshared[pair] + discovered : 0;
            const int64_t waited = least(step->waited[pair] + is_other, step->never);
            step->pending[pair] = pending;
            step->new_unshared[pair] = step->network[pair] ? 0 : pending;
            step->new_waited[pair] = step->network[pair] ? 0 : waited;
        }
    }
}

/* Says what a robot may do next. */
static void allow(const Step *step, int64_t robot) {
    const int64_t side = step->side, team = step->team;
    const int8_t *centre = step->view + robot * side * side + side * side / 2;
    const uint8_t *linked = step->linked + robot * team;
    uint8_t *allowed = step->new_allowed + robot * ACTIONS;
    int walls[DIRECTIONS], others = -1; /* linked to itself */
    for (int i = 0; i < DIRECTIONS; i++) {
        const int8_t cell = centre[STEP_ROW[i] * side + STEP_COLUMN[i]];
        walls[i] = cell & WALL;
        allowed[i] = cell == OPEN;
    }
    for (int i = 1; i < DIRECTIONS; i += 2) /* diagonals between two walls */
        allowed[i] &= !(walls[i - 1] & walls[(i + 1) % DIRECTIONS]);
    allowed[STAY] = 1;
    for (int64_t j = 0; j < team; j++)
        others += linked[j];
    allowed[COMMUNICATE] = others > 0;
}

/* Steps arenas `first` to `last` - 1; `side` is odd and at least 3. Returns 0, 1 when memory is
 * out, 2 when a robot is outside its arena, or 4 when there is no such action. */
int marl_explore_step(const Step *step, int64_t first, int64_t last) {
    const int64_t team = step->team, height = step->height, width = step->width;
    const int64_t side = step->side, stride = width + side - 1;
    const Looks looks = {
        .walls = step->walls,
        .own = step->own,
        .masks = step->masks,
        .view = step->view,
        .team = team,
        .cells = (height + side - 1) * stride,
        .width = stride,
        .num_kinds = step->num_kinds,
        .side = side,
        .hides = step->hides,
    };
    const Readings readings = {
        .view = step->view,
        .position = step->position,
        .target = step->target,
        .maps = step->maps,
        .discovered = step->discovered,
        .targets = step->targets,
        .team = team,
        .height = height,
        .width = width,
        .side = side,
    };
    const Teams teams = {
        .linked = step->linked,
        .communicating = step->communicating,
        .target = step->target,
        .maps = step->maps,
        .network = step->network,
        .received = step->received,
        .targets = step->more_targets,
        .team = team,
        .cells = height * width,
    };
    int failed = DONE;
    for (int64_t arena = first; arena < last && !failed; arena++) {
        failed = move(step, arena);
        if (!failed)
            link_near(step, arena);
    }
    if (!failed)
        failed = marl_explore_surroundings(&looks, first * team, last * team);
    if (!failed)
        failed = marl_explore_sense(&readings, first * team, last * team);
    if (!failed)
        failed = marl_explore_merge(&teams, first, last);
    for (int64_t arena = first; arena < last && !failed; arena++) {
        count(step, arena);
        for (int64_t robot = arena * team; robot < (arena + 1) * team; robot++)
            allow(step, robot);
    }
    return failed;
}
