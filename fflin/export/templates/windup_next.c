    limit_windup(E$table, u, next);
