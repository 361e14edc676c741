        for (j = 0; j < ${NAME}_INPUTS; j++) {
            next[i] += E$table[i][j] * cut(u[j], j);
        }
