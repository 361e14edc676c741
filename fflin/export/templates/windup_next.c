        for (j = 0; j < ${NAME}_INPUTS; j++) {
            next[i] += E[i][j] * cut(u[j], j);
        }
