/* Robots that communicate merge their maps (core/world.py is the reference).
 *
 * Plain C99, no dependency but the standard library; one call is one thread's share.
 */
#include "world.h"

#include <stdlib.h>

/* Collects the robots that communicate and are joined to `robot` by chains of links; returns how
 * many. Those found are marked as done. */
static int64_t collect(const Teams *teams, int64_t arena, int64_t robot, uint8_t *done,
                       int64_t *members) {
    const int64_t team = teams->team;
    const uint8_t *linked = teams->linked + arena * team * team;
    const uint8_t *communicating = teams->communicating + arena * team;
    int64_t number = 1;
    members[0] = robot;
    done[robot] = 1;
    for (int64_t next = 0; next < number; next++)
        for (int64_t other = 0; other < team; other++)
            if (communicating[other] && !done[other] && linked[members[next] * team + other]) {
                done[other] = 1;
                members[number++] = other;
            }
    return number;
}

/* Gives all members of a network the union of their maps; unknown is the lowest value. */
static void merge(const Teams *teams, int64_t arena, const int64_t *members, int64_t number,
                  int8_t *whole) {
    const int64_t team = teams->team, cells = teams->cells;
    const uint8_t *target = teams->target + arena * cells;
    memset(whole, UNKNOWN, cells);
    for (int64_t i = 0; i < number; i++) {
        const int8_t *map = teams->maps + (arena * team + members[i]) * cells;
        for (int64_t cell = 0; cell < cells; cell++)
            whole[cell] = map[cell] > whole[cell] ? map[cell] : whole[cell];
    }
    for (int64_t i = 0; i < number; i++) {
        const int64_t robot = arena * team + members[i];
        int8_t *map = teams->maps + robot * cells;
        int64_t received = 0, targets = 0;
        for (int64_t cell = 0; cell < cells; cell++) {
            const int new = (map[cell] == UNKNOWN) & (whole[cell] != UNKNOWN);
            received += new;
            targets += new & target[cell];
        }
        memcpy(map, whole, cells);
        teams->received[robot] = received;
        teams->targets[robot] = targets;
        for (int64_t j = 0; j < number; j++)
            teams->network[robot * team + members[j]] = 1;
    }
}

/* Merges in arenas `first` to `last` - 1. Returns 0, or 1 when memory is out. */
int marl_explore_merge(const Teams *teams, int64_t first, int64_t last) {
    const int64_t team = teams->team;
    int64_t *members = malloc(team * sizeof *members);
    uint8_t *done = malloc(team);
    int8_t *whole = malloc(teams->cells);
    const int failed = members == NULL || done == NULL || whole == NULL;
    for (int64_t arena = first; !failed && arena < last; arena++) {
        memset(done, 0, team);
        for (int64_t robot = 0; robot < team; robot++) {
            if (!teams->communicating[arena * team + robot] || done[robot])
                continue;
            const int64_t number = collect(teams, arena, robot, done, members);
            if (number > 1)
                merge(teams, arena, members, number, whole);
        }
    }
    free(members);
    free(done);
    free(whole);
    return failed ? NO_MEMORY : DONE;
}
